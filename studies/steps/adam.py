"""Joint optimisation by differentiable rendering in Mitsuba 3: Adam on texels and reflectances.

Unknowns   per light the texels of an `envmap` of 16 × 32, not negative; per material k_d, k_s and roughness of the blend
           of `diffuse` and `roughconductor` that this project exports, its weight one half.
Pictures   integrator `prb`, direct light alone, `SPP` samples a pixel in each pass, forward and backward with seeds of their own.
Loss       mean squared difference over the picture's peak, all pairs together; one step of Adam after all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from factorlib.model.materials import ROUGHNESS, Materials

ROWS, SPP, FLAT = 16, 16, 60


class Joint:
    """The unknowns that all pairs of a material and a light share; who derives from it makes the scene of each pair.

    mi: Mitsuba's module;  spheres: materials, illuminations and pairs by name, each with its `peak`;  mask: of the pixels that count
    scenes, parameters, shown: by pair;  integrator
    """

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
                self.scenes[pair],
                parameters,
                integrator=self.integrator,
                spp=SPP,
                spp_grad=SPP,
                seed=seed,
                seed_grad=seed + 1,
            )
            scale = self.mi.TensorXf(
                np.repeat(self.mask[..., None], 3, 2).astype(np.float32) / self.spheres.pairs[pair].peak
            )
            squares = dr.square((image - self.mi.TensorXf(self.shown[pair])) * scale)
            loss = dr.sum(squares, axis=None) / (3.0 * float(self.mask.sum()))
            dr.backward(loss / len(self.parameters))
            losses.append(float(np.array(loss).item()))
        self.optimiser.step()
        for name in self.optimiser.keys():  # noqa: SIM118
            low, high = (
                ROUGHNESS if name.endswith("roughness") else (1e-4, 1e6 if name in self.spheres.illuminations else 1.0)
            )
            self.optimiser[name] = dr.clip(self.optimiser[name], low, high)
        return losses

    def _set(self, parameters: Any, pair: tuple[str, str]) -> None:
        material, light = pair
        parameters["light.data"] = self.optimiser[light]
        parameters["ball.bsdf.bsdf_0.reflectance.value"] = 2 * self.optimiser[f"{material} diffuse"]
        parameters["ball.bsdf.bsdf_1.specular_reflectance.value"] = 2 * self.optimiser[f"{material} specular"]
        parameters["ball.bsdf.bsdf_1.alpha.value"] = self.optimiser[f"{material} roughness"] ** 2
        parameters.update()

    def materials(self) -> Materials:
        def of(kind: str) -> np.ndarray:
            return np.array(
                [np.array(self.optimiser[f"{name} {kind}"], dtype=float).reshape(-1) for name in self.spheres.materials]
            )

        return Materials(of("diffuse"), of("specular"), of("roughness")[:, 0])
