"""Photos that share three materials, whose poses are known and are had wrong: what `refine` is tested and measured on.

A set is four photos that share three materials, each of one object in a light of its own, rendered by the operator itself on
meshes and poses that are known, with 1 % noise.  What the pipeline has is worse: the poses of all photos are off, and materials
are solved with the wrong poses before any is refined.

    turned 2–8°     every pose turned about a random axis           as found    by contours from the true pose: right already
    rough           as found, the mesh coarse and warped by 3 %
    front/back      a symmetric seat, far away, in two of the photos: its mirror image, seen from the other side, has its outline
"""

from __future__ import annotations

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from factorlib.align.refine import FocalPrior, refined
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State, state_of
from factorlib.align.target import target_of
from factorlib.generate.chair import chair, labelled
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.mesh import Mesh
from factorlib.inference.blocks import Block
from factorlib.inference.forward import Illumination
from factorlib.inference.lights import Light
from factorlib.inference.materials import Materials
from factorlib.refine.light import Surfaces
from factorlib.refine.photo import PosedObject, Refined, Scene, refined_photo
from factorlib.refine.pixels import pixels_of
from factorlib.reflection.operator import Operator
from studies.scenes import shapes
from studies.scenes.problems import random_light

WIDTH, HEIGHT = 320, 240
NOISE = 0.01
TRUE = Materials(
    np.array([[0.5, 0.12, 0.1], [0.15, 0.4, 0.2], [0.2, 0.22, 0.35]]),
    np.array([[0.06, 0.06, 0.06], [0.2, 0.2, 0.2], [0.35, 0.33, 0.3]]),
    np.array([0.6, 0.4, 0.25]),
)
OBJECTS = (("chair", (0, 1)), ("jug", (1, 2)), ("blob", (0,)), ("stack", (2,)))  # shape, material of each label
AMBIGUOUS = (("seat", (2,)), ("jug", (1, 2)), ("chair", (0, 1)), ("seat", (1,)))
KINDS = ("turned", "as found", "rough", "front/back")


class Photo(msgspec.Struct, frozen=True):
    """What was photographed, and what is had of it: a mesh, a wrong pose, and in front/back the true one as runner-up."""

    shape: str
    camera: Camera
    truth: Pose
    caster: Caster
    given: Caster
    channels: dict
    pose: Pose
    runner_up: Pose | None


def mesh_of(shape: str, materials: tuple[int, ...], rough: int | None = None) -> Mesh:
    """The shape with the set's labels."""
    if shape == "seat":
        return labelled({"shell": chair()["shell"]}, {"shell": materials[0] + 1})
    mesh = shapes.mesh(shape) if rough is None else shapes.rough(shape, rough)
    return msgspec.structs.replace(mesh, face_label=(np.array(materials) + 1)[mesh.face_label - 1].astype(np.int16))


def photographed(kind: str, number: int, rng: np.random.Generator, operator: Operator) -> Photo:
    shape, materials = (AMBIGUOUS if kind == "front/back" else OBJECTS)[number]
    caster = Caster(mesh_of(shape, materials))
    given = Caster(mesh_of(shape, materials, number)) if kind == "rough" else caster
    flipped = kind == "front/back" and shape == "seat"
    camera = Camera(WIDTH, HEIGHT, (30.0 if flipped else 1.5) * WIDTH, (WIDTH / 2, HEIGHT / 2))
    if flipped:  # from a little above, from any side
        turn, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 0.4)
        rotation = rotation_of_vector(np.array([np.pi - tilt, 0, 0])) @ rotation_of_vector(np.array([0, turn, 0]))
    else:
        rotation = Rotation.random(rng=rng).as_matrix()
    middle = np.array([0, 0, 2 * camera.focal * caster.radius / (0.9 * HEIGHT)])
    truth = Pose(rotation, middle - rotation @ caster.centre)
    channels = rendered(caster, camera, truth, random_light(rng, 40, sharpest=5.5, contrast=0.8), rng, operator)
    silhouette = Silhouette(channels["label"].astype(np.int16))
    if flipped:
        mirrored = np.diag([1.0, 1, -1]) @ rotation @ np.diag([-1.0, 1, 1])  # x is the chair's left and right
        wrong = by_contours(
            given, silhouette, camera, state_of(Pose(mirrored, middle - mirrored @ given.centre), camera, given)
        )
        return Photo(shape, camera, truth, caster, given, channels, wrong.pose(given), truth)
    by = np.deg2rad(rng.uniform(2, 8)) if kind == "turned" else 0.0
    axis = rng.normal(size=3)
    turned = rotation_of_vector(by * (axis / np.linalg.norm(axis))) @ rotation
    start = state_of(Pose(turned, middle - turned @ given.centre), camera, given)
    pose = (start if kind == "turned" else by_contours(given, silhouette, camera, start)).pose(given)
    return Photo(shape, camera, truth, caster, given, channels, pose, None)


def by_contours(caster: Caster, silhouette: Silhouette, camera: Camera, start: State) -> State:
    target = target_of(silhouette, caster.mesh.labels, 200, 0.1)
    return refined(caster, target, camera, start, FocalPrior(camera.focal, 0.0), 12).state


def rendered(
    caster: Caster, camera: Camera, pose: Pose, light: Light, rng: np.random.Generator, operator: Operator
) -> dict:
    """The channels that `masks` would write."""
    maps = rasterise(caster, camera, pose)
    y, x = np.nonzero(maps.label)
    order = np.argsort(maps.label[y, x], kind="stable")
    y, x = y[order], x[order]
    n, material = len(y), maps.label[y, x] - 1
    block = Block(
        "light", ("photo",), 1.0, maps.normal[y, x], maps.view[y, x], np.zeros((n, 3)), np.zeros((n, 3), bool), np.ones((n, 3)),
        material.astype(int), np.zeros(n, int), np.zeros(n, bool),
    )  # fmt: skip
    radiance = Illumination(block, light, TRUE, operator).radiance()
    picture = np.zeros((HEIGHT, WIDTH, 3))
    picture[y, x] = radiance / np.quantile(radiance.max(1), 0.99) * 0.9
    picture += NOISE * rng.normal(size=picture.shape)
    channels = {c: np.clip(picture[..., k], 0, 1) for k, c in enumerate("RGB")}
    channels |= {f"clipped.{c}": (picture[..., k] >= 1).astype(float) for k, c in enumerate("RGB")}
    return channels | {"label": maps.label.astype(float), "valid": np.ones(maps.label.shape)}


def normal_error(photo: Photo, pose: Pose) -> float:
    """Median angle over the true silhouette where both see the object, degrees."""
    truth, found = rasterise(photo.caster, photo.camera, photo.truth), rasterise(photo.given, photo.camera, pose)
    both = (truth.label > 0) & (found.label > 0)
    cosine = np.sum(truth.normal[both] * found.normal[both], axis=1)
    return float(np.rad2deg(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def refined_of(photo: Photo, materials: Materials, operator: Operator) -> Refined:
    pixels = pixels_of(photo.channels, [True] * 3, 2400)
    own = PosedObject(photo.given, Silhouette(photo.channels["label"].astype(np.int16)), photo.pose, photo.runner_up)
    scene = Scene(photo.camera, [own], FocalPrior(photo.camera.focal, 0.0))
    return refined_photo(scene, pixels, Surfaces(materials, operator))[0]
