"""How right shapes and cameras are that no file gives: `python -m studies.measured.shapes`, some minutes.

Bodies of the generator are seen from known cameras in photos of 320 × 240.  Normals are compared with the body's own in three views, in degrees: median
and 90 %.  Structure from motion sees a grained body on a grained ground, in photos of one megapixel.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from factorlib.generate.shapes import SHAPES
from factorlib.geometry.camera import angle_between
from factorlib.geometry.raster import rasterise
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read import read_mesh
from factorlib.shapes.hull import visual_hull
from factorlib.shapes.lathe import body_of_revolution
from factorlib.shapes.motion import cameras_by_motion
from factorlib.shapes.outline import Triangles, write_obj
from factorlib.shapes.primitive import primitive, unit
from studies.scenes.outlines import CAMERA, looking_from, outline, views_of

HULLS, LATHES, PHOTOS, SIDE = (6, 10, 20), (1, 3, 9), 20, 1000
SIDES = {"box": (1.0, 0.4, 0.7), "cylinder": (1.0, 0.3, 1.0)}


def normals_off(shape: Triangles, body: Mesh) -> str:
    """The errors of the shape's normals as they are read from its file, in words."""
    with tempfile.TemporaryDirectory() as folder:
        write_obj(Path(folder) / "shape.obj", shape, ["all"])
        read, errors = read_mesh(Path(folder) / "shape.obj", ["red"], "red"), []
    for pose in (looking_from(5, 40), looking_from(25, 77), looking_from(40, 200)):
        true, found = rasterise(body, CAMERA, pose), rasterise(read, CAMERA, pose)
        both = (true.label > 0) & (found.label > 0)
        cosine = np.sum(true.normal[both] * found.normal[both], axis=-1)
        errors.append(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
    return "{:.1f}°, {:.1f}°".format(*np.quantile(np.concatenate(errors), [0.5, 0.9]))


def main() -> None:
    """Print a line for each shape, and one for the cameras."""
    for name in ("blob", "vase"):
        for count in HULLS:
            poses = [looking_from((20, 35, -10, 50)[k % 4], 360 / count * k + 3) for k in range(count)]
            hull = visual_hull([outline(SHAPES[name](), pose, True) for pose in poses], 80)
            print(f"hull of a {name}, {count} photos: normals off by {normals_off(hull, SHAPES[name]())}", flush=True)
    for name in ("vase", "bottle"):
        for count in LATHES:
            poses = [looking_from((-10, 35, 20)[k % 3], 50 * k) for k in range(count)]
            shape = body_of_revolution([outline(SHAPES[name](), pose, True) for pose in poses])
            print(
                f"{name} by lathe, {count} photos, poses given: normals off by {normals_off(shape, SHAPES[name]())}",
                flush=True,
            )
    for kind, sides in SIDES.items():
        for count in (1, 3):
            poses = [looking_from(25 + 8 * k, 20 + 40 * k) for k in range(count)]
            mesh = unit(kind, np.array(sides)).as_mesh()
            extent = np.ptp(primitive(kind, [outline(mesh, pose, False) for pose in poses]).vertices, axis=0)
            off = np.abs(np.sort(extent) - np.sort(sides)).max()
            print(f"{kind}, {count} photos: sides off by {off:.3f} of the longest", flush=True)
    poses = [looking_from(20 + 15 * (k % 2), 18.0 * k) for k in range(PHOTOS)]
    views, begun = views_of(SHAPES["blob"](), poses, poses, SIDE), time.perf_counter()
    found = cameras_by_motion(views)
    taken, order = time.perf_counter() - begun, list(views)
    turns = [(poses[order.index(n)].rotation @ poses[order.index(next(iter(found)))].rotation.T, n) for n in found]
    first = found[next(iter(found))].pose.rotation
    off = max(angle_between(turn, found[n].pose.rotation @ first.T) for turn, n in turns)
    focal = max(abs(each.focal / (1.3 * SIDE) - 1) for each in found.values())
    print(
        f"structure from motion: {len(found)} of {PHOTOS} photos in {taken:.0f} s, rotations off by {off:.2f}°, focal length by {focal:.2%}"
    )


if __name__ == "__main__":
    main()
