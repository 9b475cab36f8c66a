"""R(lobe | material): what a surface of Lambert + GGX reflectance reflects of one light lobe.

Four operators compute it, behind one interface (`reflection_operator`): `reference` by quadrature, `closed_form` by
formula, `network` by a learned correction of the formula, compiled where there is a C compiler, and `paper_network`, the
baseline, by networks that know no formula.

By symmetry the diffuse part depends on 2 scalars (λ, n·z) and the specular part on 5 (α, λ, n·o, n·z, o·z).
"""

from factorlib.reflection.operator import Operator, Response, reflection_operator

__all__ = ["Operator", "Response", "reflection_operator"]
