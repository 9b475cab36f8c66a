"""The labelling page: masks that are read and written, strangers that are refused, and what a browser makes of it."""

import http.client
import re
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image

from factorlib.labelling.server import MaskSet, Server
from factorlib.labels.mask_files import read_values
from tests.browser import CHROMIUM, started
from tests.faults.sample import put
from tests.labels.test_label_image import scene
from tests.refusal import refusal

ROOT = Path(__file__).resolve().parents[2]
WHY = "no Chromium on this machine (Debian: apt-get install chromium): no browser opens the page"
YAML = """\
format: 1
materials: [red, brown]
meshes: {thing: {file: "?", parts: {a: "?"}}}
photos:
  - {name: day, image: day.png, masks: masks/day.png, objects: "?"}
  - {name: side, image: side.jpg, masks: given.png}
"""


@pytest.fixture
def folder(tmp_path):
    """An unfinished data set: the photo `day` has no mask yet; `side` has one, and is displayed turned, for its EXIF says so."""
    folder = put(tmp_path / "set" / "dataset.yaml", YAML).parent
    Image.fromarray(scene()[1]).save(folder / "day.png")
    (turned := Image.Exif())[0x0112] = 6
    Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(folder / "side.jpg", exif=turned)
    Image.fromarray(np.tri(30, 20, dtype=np.uint8)).save(folder / "given.png")
    return folder


@contextmanager
def served(folder):
    with Server(MaskSet(folder)) as server:
        Thread(target=server.serve_forever).start()
        try:
            yield server
        finally:
            server.shutdown()


def asked(server, method, path, body=b"", **headers):
    """Status, headers and body of the answer; a header that is None is left out."""
    own = {"Host": server.host, "X-Token": server.token, "Content-Length": len(body)}
    line = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    line.putrequest(method, path, skip_host=True)
    for name, value in {**own, **{name.replace("_", "-"): value for name, value in headers.items()}}.items():
        if value is not None:
            line.putheader(name, value)
    line.endheaders(body)
    with suppress(OSError):  # answered already
        line.sock.shutdown(1)
    answer = line.getresponse()
    return answer.status, answer.headers, answer.read()


def test_masks_are_of_the_photo_as_displayed_and_saved_whole(folder):
    masks = MaskSet(folder)
    assert masks.sizes == [(60, 60), (30, 20)] == [masks.picture(k).shape[:2] for k in (0, 1)]
    (given, version), (drawn, none) = masks.read(1), masks.read(0)
    assert np.array_equal(given, np.tri(30, 20)) and not drawn.any()
    drawn[:2], drawn[2] = 2, 255
    masks.save(0, drawn, none)
    assert np.array_equal(read_values(folder / "masks/day.png", "day"), drawn)
    assert (folder / "dataset.yaml").read_text() == YAML and len([*folder.rglob("*")]) == 6
    Image.fromarray(given * 2).save(folder / "given.png")
    for labels, of, fault in ((given, version, "changed on disk"), (given + 2, masks.version(1), "unknown label 3")):
        refusal(fault, masks.save, 1, labels, of)
    assert np.array_equal(masks.read(1)[0], given * 2)


@pytest.mark.parametrize(
    "old, new",
    [("given.png", "../given.png"), ("side.jpg", "/etc/hostname"), ("name: side", "name: ../side"), ("name: side", "name: day"),
     ("[red, brown]", '["?"]'), ("given.png", "coco.json"), ("given.png", "{red: given.png}")],
)  # fmt: skip
def test_what_leads_outside_or_has_no_name_is_refused(folder, old, new):
    put(folder / "dataset.yaml", YAML.replace(old, new))
    caught = refusal(".", MaskSet, folder)
    assert caught.cure and caught.key


def test_strangers_read_and_write_nothing(folder):
    """Without the token, by another name for this address (DNS rebinding), or from another page."""
    before = (folder / "given.png").read_bytes()
    with served(folder) as server:
        version = server.masks.version(1)
        of = {name: f"{name}:{server.server_port}" for name in ("localhost", "evil.example")}
        strangers = {
            "X_Token": (None, "", "guess", "\xfc"),
            "Host": (None, "127.0.0.1", *of.values()),
            "Origin": ("null", f"https://{server.host}", *(f"http://{k}" for k in of.values())),
        }
        for name, word in [(name, word) for name, words in strangers.items() for word in words]:
            page = f"GET /?token={quote(word or '') if name == 'X_Token' else server.token}"
            for asks in (page, "GET /set", "GET /mask/1", "PUT /mask/1", "POST /unsaved/1"):
                body = bytes(600) if "PUT" in asks else b"1"
                status, result, _ = asked(server, *asks.split(" "), body, **{"X_Version": version, name: word})
                assert status == 403 and "Access-Control-Allow-Origin" not in result, (name, word, asks)
        assert asked(server, "GET", f"/?token={server.token}", X_Token=None)[0] == 200
        assert asked(server, "GET", f"/mask/1?token={server.token}", X_Token=None)[0] == 403  # a stranger's link
        assert asked(server, "OPTIONS", "/mask/1")[0] == 501  # a browser asks so whether a stranger may send the header
    assert (folder / "given.png").read_bytes() == before and not server.unsaved


def test_ctrl_c_ends_it_and_names_what_is_not_saved(folder):
    command = [sys.executable, "-m", "factorlib", "label", "--dataset", str(folder), "--port"]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have handed it down as ignored
    with subprocess.Popen([*command, "0"], cwd=ROOT, stdout=subprocess.PIPE, text=True) as run:
        signal.signal(signal.SIGINT, before)
        port, token = re.search(r"127\.0\.0\.1:(\d+)/\?token=(\S+)", run.stdout.readline()).groups()
        line = http.client.HTTPConnection("127.0.0.1", int(port))
        line.request("POST", "/unsaved/1", b"1", {"X-Token": token})
        status = line.getresponse().status
        run.send_signal(signal.SIGINT)
        assert "not saved: side" in run.stdout.read() and run.wait(30) == 0 and status == 200
    refused = subprocess.run([*command, "70000"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert refused.returncode == 1 and "PORT: port 70000 cannot be used" in refused.stderr


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason=WHY)
def test_in_a_browser_by_mouse_and_keys(folder):
    truth, _, box = scene()
    mask = folder / "masks/day.png"
    with served(folder) as server:
        context = started().new_context(viewport={"width": 1440, "height": 900})
        page, complaints = context.new_page(), []
        page.on(
            "console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(server.url)

        def drawn(key, *corners):
            """Choose by a key, drag between pixels of the photo of 60 × 60, and wait until labels have grown."""
            page.keyboard.press(key)
            at = page.locator("canvas").first.bounding_box()
            scale = min(at["width"], at["height"]) / 60
            centre = np.array([at["x"] + at["width"] / 2, at["y"] + at["height"] / 2])
            places = (centre + scale * (np.array(corners) - 30)).tolist()
            page.mouse.move(*places[0])
            page.mouse.down()
            page.mouse.move(*places[-1], steps=3)
            page.mouse.up()
            page.locator("#said:not(:text('growing'))").wait_for()

        def saved(key="s"):
            with page.expect_response("**/unsaved/0"):  # told once the mask is saved
                page.keyboard.press(key)
            return read_values(mask, "day")

        page.get_by_role("img", name="day: no label yet").wait_for()
        drawn("g", (30, 22))
        page.get_by_text("First draw a box").wait_for()
        drawn("x", (30, 22))
        page.get_by_text("A box is dragged").wait_for()
        drawn("x", box[:2], box[2:])
        drawn("g", (30, 22))
        page.keyboard.press("2")
        page.get_by_role("button", name="brown", pressed=True).wait_for()
        drawn("g", (30, 40), (30, 48))
        drawn("x", box[:2], box[2:])  # again, with another label: what was clicked stays
        assert ((grown := saved()) == truth).mean() > 0.98 and not server.unsaved
        page.keyboard.press("l")
        drawn("b", (5, 5), (9, 5))
        page.keyboard.press("Control+z")
        drawn("e", (30, 22), (31, 22))
        erased = saved("Control+s")
        assert erased[22, 30] == 0 and not (erased == 255).any() and (erased != grown).sum() < 60
        Image.fromarray(truth).save(mask)
        drawn("e", (20, 22), (21, 22))
        page.keyboard.press("s")
        page.get_by_text("has changed on disk meanwhile").wait_for()
        assert np.array_equal(read_values(mask, "day"), truth)
        page.keyboard.press("p")
        page.get_by_role("img", name="side: red").wait_for()
        page.keyboard.press("ArrowRight")
        page.locator("figure.current figcaption:has-text('side')").wait_for()
        assert page.evaluate("[document.body.scrollWidth <= 1440, document.body.scrollHeight <= 900]") == [True, True]
        assert [line for line in complaints if "400" not in line] == [] and server.unsaved == {0}
        context.close()
