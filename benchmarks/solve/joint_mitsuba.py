"""Joint optimisation by differentiable rendering in Mitsuba 3: Adam on texels and reflectances.

Unknowns   per light the texels of an `envmap` of 16 × 32, not negative; per material k_d, k_s and roughness of the blend
           of `diffuse` and `roughconductor` that this project exports, its weight one half.
Pictures   of 64², means over 4 × 4 pixels, those where all sixteen count; integrator `prb`, direct light alone, `SPP`
           samples a pixel in each pass, forward and backward with seeds of their own.
Loss       mean squared difference over the picture's peak, all pairs together; one step of Adam after all of them.
End        flat: the mean loss of the last `FLAT` steps is within 1 % of that of as many before; or the time limit.
Points     on the way: mean over pairs of the dB of the last eight losses, which hold the noise of `SPP` samples a pixel.
Score      pictures of 256² by Mitsuba, `SCORE_SPP` samples; the best of the learning rates by final loss, all their times.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.solve.clock import Clock
from benchmarks.solve.scores import material_scores, picture_scores
from benchmarks.solve.sets import DISTANCE, SIZE, SphereSet, camera, sphere
from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.geometry.camera import Camera
from factorlib.model.bounds import ROUGHNESS
from factorlib.model.materials import Materials
from factorlib.tracing.scene import rgb, rigid, sensor
from factorlib.tracing.variant import mitsuba

RATES = (0.003, 0.01, 0.03)
ROWS, SPP, SCORE_SPP, FLAT, SMALL = 16, 16, 256, 60, 64


def run(spheres: SphereSet, limit_s: float) -> dict:
    """Scores of the best learning rate, and what each reached; `limit_s` of wall time is shared by the rates."""
    tries = {f"{rate:g}": _optimised(Joint(spheres), rate, limit_s / len(RATES)) for rate in RATES}
    best = min(tries, key=lambda rate: tries[rate]["loss"])
    chosen = tries[best]
    joint = chosen.pop("joint")
    summary = {rate: {k: v for k, v in row.items() if k not in ("joint", "points")} for rate, row in tries.items()}
    row = {"resynthesis": picture_scores(joint.pictures(), spheres), "materials": material_scores(joint.materials(), spheres)}
    total = {k: sum(t["taken"][k] for t in tries.values()) for k in ("wall", "processor")}
    return row | {"points": chosen["points"], "rate": best, "rates": summary, "all_rates": total, "resolution": SMALL}


def _optimised(joint: Joint, rate: float, limit_s: float) -> dict:
    clock, by_pair, losses, points = Clock(), [], [], []
    joint.begin(rate)
    while True:
        by_pair.append(joint.step(len(losses)))
        losses.append(float(np.mean(by_pair[-1])))
        taken, flat = clock.taken(), _flat(losses)
        done = flat or taken.wall > limit_s
        if done or len(losses) & (len(losses) - 1) == 0:  # powers of two
            errors = material_scores(joint.materials(), joint.spheres)
            kept = {kind: errors[kind]["mean"] for kind in ("diffuse", "specular", "roughness")}
            db = np.mean(-10 * np.log10(np.mean(by_pair[-8:], axis=0)))
            points.append({"stage": f"step {len(losses)}", **msgspec.to_builtins(taken), "mean_db": float(db), **kept})
        if done:
            loss = float(np.mean(losses[-FLAT:]))
            return {"joint": joint, "loss": loss, "steps": len(losses), "flat": flat, "taken": msgspec.to_builtins(taken), "points": points}


def _flat(losses: list[float]) -> bool:
    if len(losses) < 2 * FLAT:
        return False
    before, now = np.mean(losses[-2 * FLAT : -FLAT]), np.mean(losses[-FLAT:])
    return bool(now > 0.99 * before)


class Joint:
    """One scene a pair, and the unknowns they share."""

    def __init__(self, spheres: SphereSet):
        self.mi, self.spheres = mitsuba(), spheres
        self.small, self.mask = _shrunk_camera(), _shrunk_mask()
        self.scenes = {pair: self._scene(self.small) for pair in spheres.pairs}
        self.parameters = {pair: self.mi.traverse(scene) for pair, scene in self.scenes.items()}
        self.shown = {pair: _shrunk(picture.radiance) for pair, picture in spheres.pairs.items()}
        self.integrator = self.mi.load_dict({"type": "prb", "max_depth": 2})

    def _scene(self, seen_by: Camera):
        gloss = {
            "type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.16, "specular_reflectance": rgb(0.2),
        }  # fmt: skip
        look = {"type": "blendbsdf", "weight": 0.5, "bsdf_0": {"type": "diffuse", "reflectance": rgb(0.6)}, "bsdf_1": gloss}
        bitmap = self.mi.Bitmap(np.ones((ROWS, 2 * ROWS, 3), np.float32))
        return self.mi.load_dict({
            "type": "scene", "integrator": {"type": "prb", "max_depth": 2}, "sensor": sensor(seen_by, rigid(YUP_FROM_CAMERA, np.zeros(3)), slice(None)),
            "ball": {"type": "sphere", "center": [0, 0, -DISTANCE], "bsdf": look}, "light": {"type": "envmap", "bitmap": bitmap},
        })  # fmt: skip

    def begin(self, rate: float) -> None:
        """Grey materials under even lights of the pictures' mean radiance."""
        mi, optimiser = self.mi, self.mi.ad.Adam(lr=rate)
        columns = np.array(next(iter(self.parameters.values()))["light.data"]).shape[1]
        for light in self.spheres.illuminations:
            level = np.mean([self.shown[pair][self.mask].mean() for pair in self.shown if pair[1] == light]) / 0.4
            optimiser[light] = mi.TensorXf(np.full((ROWS, columns, 3), level, np.float32))
        for name in self.spheres.materials:
            optimiser[f"{name} diffuse"], optimiser[f"{name} specular"] = mi.Color3f(0.3), mi.Color3f(0.1)
            optimiser[f"{name} roughness"] = mi.Float(0.4)
        self.optimiser = optimiser

    def step(self, number: int) -> list[float]:
        """Gradients of all pairs, then one step within bounds; each pair's loss before it."""
        import drjit as dr

        losses = []
        for k, (pair, parameters) in enumerate(self.parameters.items()):
            self._set(parameters, pair)
            seed = 2 * (number * len(self.parameters) + k)
            image = self.mi.render(
                self.scenes[pair], parameters, integrator=self.integrator, spp=SPP, spp_grad=SPP, seed=seed, seed_grad=seed + 1
            )
            scale = self.mi.TensorXf(np.repeat(self.mask[..., None], 3, 2).astype(np.float32) / self.spheres.pairs[pair].peak)
            squares = dr.square((image - self.mi.TensorXf(self.shown[pair])) * scale)
            loss = dr.sum(squares, axis=None) / (3.0 * float(self.mask.sum()))
            dr.backward(loss / len(self.parameters))
            losses.append(float(np.array(loss).item()))
        self.optimiser.step()
        for name in self.optimiser.keys():  # noqa: SIM118
            low, high = ROUGHNESS if name.endswith("roughness") else (1e-4, 1e6 if name in self.spheres.illuminations else 1.0)
            self.optimiser[name] = dr.clip(self.optimiser[name], low, high)
        return losses

    def _set(self, parameters, pair: tuple[str, str]) -> None:
        material, light = pair
        parameters["light.data"] = self.optimiser[light]
        parameters["ball.bsdf.bsdf_0.reflectance.value"] = 2 * self.optimiser[f"{material} diffuse"]
        parameters["ball.bsdf.bsdf_1.specular_reflectance.value"] = 2 * self.optimiser[f"{material} specular"]
        parameters["ball.bsdf.bsdf_1.alpha.value"] = self.optimiser[f"{material} roughness"] ** 2
        parameters.update()

    def materials(self) -> Materials:
        def of(kind: str) -> np.ndarray:
            return np.array([np.array(self.optimiser[f"{name} {kind}"], dtype=float).reshape(-1) for name in self.spheres.materials])

        return Materials(of("diffuse"), of("specular"), of("roughness")[:, 0])

    def pictures(self) -> dict[tuple[str, str], Float[np.ndarray, "n 3"]]:
        """All pairs at full size."""
        scene = self._scene(camera())
        parameters, found = self.mi.traverse(scene), {}
        for k, pair in enumerate(self.spheres.pairs):
            self._set(parameters, pair)
            found[pair] = np.array(self.mi.render(scene, spp=SCORE_SPP, seed=k), dtype=float)[sphere()[2]]
        return found


def _shrunk_camera() -> Camera:
    whole = camera()
    return Camera(SMALL, SMALL, whole.focal * SMALL / SIZE, (SMALL / 2, SMALL / 2))


def _shrunk(picture: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "small small 3"]:
    times = SIZE // SMALL
    return picture.reshape(SMALL, times, SMALL, times, 3).mean(axis=(1, 3)).astype(np.float32)


def _shrunk_mask() -> Bool[np.ndarray, "small small"]:
    times = SIZE // SMALL
    return sphere()[2].reshape(SMALL, times, SMALL, times).all(axis=(1, 3))
