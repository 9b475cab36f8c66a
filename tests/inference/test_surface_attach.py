"""Nodes under pixels: they are where the pixel's ray meets the mesh, in the frame of the object's pose, whichever side is seen."""

import msgspec
import numpy as np

from factorlib.generate.solids import sphere
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.inference.surface_turns import Surfaces, attach_pixels
from factorlib.meshes.mesh import Mesh, scaled
from factorlib.meshes.subdivision import subdivided_mesh
from factorlib.results.poses import ObjectPose, entry_of

CAMERA = Camera(60, 50, 80.0, (30.0, 25.0))


def ball(offset=0.0) -> Mesh:
    """A ball of radius 1 beside its origin."""
    whole = sphere(1.0)
    return msgspec.structs.replace(whole, vertices=whole.vertices + [offset, 0, 0])


def entry(pose: Pose, scale=(1.0, 1.0, 1.0)) -> ObjectPose:
    """An entry of poses.json."""
    return ObjectPose(**entry_of(pose), scale=scale)


def test_pixels_of_two_objects_know_their_nodes_and_their_pose():
    random = np.random.default_rng(0)
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(2)]
    turns = [turn * np.sign(np.linalg.det(turn)) for turn in turns]
    poses = [Pose(turns[0], np.array([-1.2, 0, 5.0])), Pose(turns[1], np.array([1.3, 0.2, 6.0]))]
    meshes, scale = {"apple": ball(), "pear": ball(0.3)}, (1.0, 1.2, 0.8)
    maps = rasterise([meshes["apple"], scaled(meshes["pear"], scale)], CAMERA, poses)
    surfaces = Surfaces({name: subdivided_mesh(mesh) for name, mesh in meshes.items()})
    objects = {"a": ("apple", entry(poses[0])), "b": ("pear", entry(poses[1], scale))}
    y, x = np.nonzero(maps.object >= 0)
    at = attach_pixels(np.column_stack([x, y]), maps.object[y, x], CAMERA, objects, surfaces)
    place = np.zeros((surfaces.nodes, 3))
    for name, own in surfaces.meshes.items():
        place[surfaces.first_nodes[name] + own.node] = own.mesh.vertices * (scale if name == "pear" else 1)
    met = np.einsum("nk,nkd->nd", at.share, place[at.node])
    for number, (pose, name) in enumerate(zip(poses, meshes), start=1):
        rows = (maps.object[y, x] == number) & at.share.any(1)
        assert rows.sum() > 100 and (at.node[rows] >= surfaces.first_nodes[name]).all()
        seen = pose.apply(met[rows])
        np.testing.assert_allclose(seen[:, 2], maps.depth[y, x][rows], atol=1e-4)
        np.testing.assert_allclose(at.share[rows].sum(1), 1)
        if name == "apple":  # whose axes are as they were
            np.testing.assert_allclose(at.frame[rows], np.broadcast_to(pose.rotation, (rows.sum(), 3, 3)))
    assert not at.share[maps.object[y, x] == 0].any()
