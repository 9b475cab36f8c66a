"""Label masks of a data set, and a server that shows them to a browser on this machine alone.

A request carries a random token: that of the page in its address, any other in a header, which a foreign page cannot
send.  Host must be this server's address, so that a name that resolves to 127.0.0.1 (DNS rebinding) is not served.
Origin, if a browser sends it, must be the same.  A request names a photo by its index, never a file, and its body has
the length that the photo's size implies.
"""

import hashlib
import io
import re
import secrets
import sys
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from itertools import cycle
from pathlib import Path
from threading import Lock
from typing import Annotated, Any, Literal
from urllib.parse import parse_qs, urlsplit

import msgspec
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from factorlib.dataset.check import IMAGES
from factorlib.dataset.paths import Refusal, file_exists, path_on_disk
from factorlib.dataset.read_dataset import FILE
from factorlib.dataset.schema import LEFT_OUT, AtLeastOne, Name, OneOf254
from factorlib.errors import InputError
from factorlib.images.photo import decode_photo, open_photo
from factorlib.images.picture import PALETTE, picture, png_bytes
from factorlib.images.scanlines import MOST_MEGAPIXELS, check_pixels
from factorlib.labels.grow import grow
from factorlib.labels.mask_files import read_values
from factorlib.reading import read_bytes
from factorlib.wholefile import replace_file
from factorlib.yamlfile import read_yaml

HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; img-src data:; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; connect-src 'self'; frame-ancestors 'none'",
}
NO_FILE = "none"  # version of a mask that does not exist yet


class LabelledPhoto(msgspec.Struct, frozen=True):
    """Keys of a photo in dataset.yaml that labelling needs."""

    name: Name
    image: str
    masks: Annotated[
        str,
        msgspec.Meta(description="here one label PNG a photo is drawn: name it, also if it is not there yet"),
    ]
    encoding: Literal["srgb", "linear", "gamma2.2"] | None = None


class LabelledSet(msgspec.Struct, frozen=True):
    """Keys of dataset.yaml that labelling needs; the rest may be unfinished."""

    materials: Annotated[list[Name], OneOf254]
    photos: Annotated[list[LabelledPhoto], AtLeastOne]


class MaskSet:
    """The label masks of the photos of a data set.

    A mask that does not exist yet is empty.

    Raises:
        InputError: dataset.yaml or a photo cannot be read, or a mask is not a label PNG.
    """

    def __init__(self, folder: Path):
        self.folder = folder.resolve()
        self.yaml = folder.resolve() / FILE
        self.files = []
        self.sizes = []
        if not file_exists(self.yaml, "DATASET") or not self.yaml.resolve().is_relative_to(self.folder):
            raise InputError("there is no such file in this folder", file=self.yaml, cure="create one with `make new`")
        spec = read_yaml(self.yaml, LabelledSet)
        refuse = Refusal(self.yaml, self.folder)
        self.materials = spec.materials
        self.photos = [msgspec.structs.replace(p, image=path_on_disk(self.folder, p.image)) for p in spec.photos]
        refuse.check_distinct("photos", (photo.name for photo in self.photos), "photo")
        for index, photo in enumerate(self.photos):
            key = f"photos[{index}].image"
            mask = path_on_disk(self.folder, photo.masks)
            refuse.check_path(key, photo.image, IMAGES)
            refuse.check_path(f"photos[{index}].masks", mask, (".png",), must_exist=False)
            self.files.append((self.folder / mask).resolve())
            self.sizes.append(open_photo(self.folder / photo.image, key).size)
            check_pixels(self.sizes[-1], MOST_MEGAPIXELS, self.folder / photo.image, key)
        self.picture = lru_cache(4)(self._picture)

    def _picture(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return a photo as displayed, sRGB-encoded; a linear one is exposed."""
        path = self.folder / self.photos[index].image
        photo = decode_photo(open_photo(path), self.photos[index].encoding, 1, path)
        return picture(photo.radiance, None if photo.encoding == "linear" else 1.0)

    def read(self, index: int) -> tuple[UInt8[np.ndarray, "h w"], str]:
        """Return the labels and the version of their file.

        Raises:
            InputError: The labels differ in size from the photo, or one has no material.
        """
        if (version := self.version(index)) == NO_FILE:
            return np.zeros(self.sizes[index], np.uint8), version
        labels = self._known(read_values(self.files[index], self.photos[index].name, self.sizes[index]), index)
        return labels.astype(np.uint8), version

    def save(self, index: int, labels: UInt8[np.ndarray, "h w"], version: str) -> str:
        """Write the labels and return the new version of their file.

        Args:
            index: index of the photo
            labels: the labels, of the photo's size
            version: version of the file that the labels are based on

        Raises:
            InputError: The file has changed since that version, or a label has no material.
        """
        png = png_bytes(self._known(labels, index)[..., None])
        path = self.files[index]
        if self.version(index) != version:
            raise InputError(
                "has changed on disk meanwhile: nothing was written",
                file=path,
                cure="press R to read it (what was drawn since the last save is lost), or move the file away",
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, png)
        return self.version(index)

    def version(self, index: int) -> str:
        """Return the hash of a mask's file, or NO_FILE if it does not exist."""
        if not file_exists(self.files[index], "masks"):
            return NO_FILE
        return hashlib.sha256(read_bytes(self.files[index], "a PNG")).hexdigest()

    def _known(self, labels: np.ndarray, index: int) -> np.ndarray:
        """Return the labels; InputError if one has no material."""
        if unknown := {*np.unique(labels).tolist()} - {*range(len(self.materials) + 1), LEFT_OUT}:
            raise InputError(
                f"unknown label {min(unknown)}",
                file=self.files[index],
                cure=f"known are 0 background, 1 to {len(self.materials)} the materials, {LEFT_OUT} leave out",
            )
        return labels


class Server(ThreadingHTTPServer):
    """A server of masks at `url` on 127.0.0.1.

    Attributes:
        masks: the masks
        port: the port; 0 is a free one
        unsaved: indices of photos with strokes that only the browser has
    """

    def __init__(self, masks: MaskSet, port: int = 0):
        self.masks = masks
        self.token = secrets.token_urlsafe(24)
        self.unsaved: set[int] = set()
        self.lock = Lock()
        super().__init__(("127.0.0.1", port), _Request)
        self.host = f"127.0.0.1:{self.server_port}"
        self.url = f"http://{self.host}/?token={self.token}"

    def handle_error(self, *args: Any) -> None:
        """Ignore a browser that has closed the connection; report other errors."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(*args)


class _Request(BaseHTTPRequestHandler):
    server: Server
    timeout = 60  # longest pause of a browser, seconds

    def do_GET(self) -> None:
        """Answer a request whose token, Host and Origin are right."""
        url = urlsplit(self.path)
        server = self.server
        query = {name: values[0] for name, values in parse_qs(url.query).items()}
        is_page = (self.command, url.path) == ("GET", "/")
        token = query.get("token", "") if is_page else self.headers.get("X-Token", "")
        is_own_origin = self.headers.get("Origin", f"http://{server.host}") == f"http://{server.host}"
        is_local = is_own_origin and self.headers.get_all("Host") == [server.host]
        try:
            if is_local and secrets.compare_digest(token.encode(), server.token.encode()):
                return self._send(200, *self._answer(url.path, query))
            self._send(403, b"open the address that `make label` has written")
        except InputError as error:
            self._send(400, str(error).encode())
        except OSError as error:
            self._send(500, f"{error.filename}: {error.strerror or error}: nothing was written".encode())

    do_PUT = do_POST = do_GET

    def log_message(self, *args: Any) -> None:
        """Log nothing about requests."""

    def _send(self, status: int, body: bytes, kind: str = "text/plain; charset=utf-8", version: str = "") -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind, "X-Version": version, "Content-Length": len(body)}.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(body)

    def _answer(self, path: str, query: dict[str, str]) -> tuple:
        """Return body, type and version of the requested resource."""
        masks = self.server.masks
        data = "application/octet-stream"
        resource = re.fullmatch(r"/(photo|mask|grow|unsaved)/([0-9]{1,9})", path)
        index = int(resource[2]) if resource else 0
        height, width = masks.sizes[index] if index < len(masks.sizes) else (0, 0)
        match self.command, resource[1] if resource and height else path:
            case "GET", "/":
                return (files("factorlib.labelling") / "page.html").read_bytes(), "text/html; charset=utf-8"
            case "GET", "/set":
                materials = list(zip(masks.materials, cycle(PALETTE)))  # colours that stand out from the materials
                about = {
                    "name": masks.folder.name,
                    "photos": [photo.name for photo in masks.photos],
                    "materials": materials,
                }
                return msgspec.json.encode(about), "application/json"
            case "GET", "photo":
                Image.fromarray(masks.picture(index)).save(stream := io.BytesIO(), "JPEG", quality=95)
                return stream.getvalue(), "image/jpeg"
            case "GET", "mask":
                labels, version = masks.read(index)
                return labels.tobytes(), data, version
            case "PUT", "mask":
                labels = np.frombuffer(self._body(height * width), np.uint8).reshape(height, width)
                with self.server.lock:
                    return b"", data, masks.save(index, labels, self.headers.get("X-Version", ""))
            case "POST", "grow":  # The body is the labels, then 1 where they are sure; the reply is the grown labels.
                box = tuple(map(int, re.findall("[0-9]+", query.get("box", "")[:40])))
                if len(box) != 5 or not (box[0] < box[2] <= width and box[1] < box[3] <= height and box[4] < 256):
                    raise InputError("the box is not in the photo, or has no label")
                label, sure = np.frombuffer(self._body(2 * height * width), np.uint8).reshape(2, height, width)
                return grow(box[:4], box[4], masks.picture(index), label, sure > 0).tobytes(), data
            case "POST", "unsaved":
                (self.server.unsaved.add if self._body(1) == b"1" else self.server.unsaved.discard)(index)
                return b"", data
        raise InputError("the server has no such page")

    def _body(self, length: int) -> bytes:
        """Return the request's body; InputError if it does not have the expected length."""
        if self.headers.get("Content-Length") != str(length) or len(body := self.rfile.read(length)) < length:
            raise InputError(f"the request has not the expected {length} bytes: nothing was written")
        return body


def serve(folder: Path, port: int = 0) -> None:
    """Serve the page of the data set in `folder` until Ctrl-C, then report unsaved photos.

    Raises:
        InputError: As for `MaskSet`, or the port is in use (0 is a free one).
    """
    masks = MaskSet(folder)
    try:
        server = Server(masks, port)
    except (OSError, OverflowError) as error:
        raise InputError(
            f"port {port} cannot be used ({error})", key="PORT", cure="choose another with PORT=…, or leave it out"
        ) from error
    print(f"{folder.name}: open {server.url}\n  Ctrl-C ends it", flush=True)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        with server.lock:  # Wait for a save in progress.
            names = ", ".join(masks.photos[index].name for index in sorted(server.unsaved))
            print(f"stopped; {f'not saved: {names}' if names else 'all is saved'}", flush=True)
