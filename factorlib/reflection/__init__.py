"""R(lobe | material): what a surface of Lambert + GGX reflectance reflects of one light lobe.

Four operators compute it, behind one interface (`reflection_operator`): `reference` by quadrature, `closed_form` by
formula, `network` by a learned correction of the formula, compiled where there is a C compiler, and `paper_network`, the
baseline, by networks that know no formula.

By symmetry the diffuse part depends on 2 scalars (λ, n·z) and the specular part on 5 (α, λ, n·o, n·z, o·z).

One lobe from straight above, on a white Lambertian surface that faces the viewer:

>>> import torch
>>> from types import SimpleNamespace
>>> R = reflection_operator("closed_form")
>>> up = torch.tensor([[0.0, 0.0, 1.0]])
>>> lobes = SimpleNamespace(axis=up, sharpness=torch.tensor([100.0]), weight=torch.ones(1, 3))
>>> white = SimpleNamespace(diffuse=torch.ones(3), specular=torch.zeros(3), roughness=torch.tensor(0.5))
>>> [round(float(radiance), 3) for radiance in R(lobes, white, normals=up, views=up)[0]]
[0.02, 0.02, 0.02]
"""

from factorlib.reflection.operator import Operator, Response, reflection_operator

__all__ = ["Operator", "Response", "reflection_operator"]
