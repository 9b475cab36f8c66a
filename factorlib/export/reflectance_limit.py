"""The gauge of exported materials, in which other programs accept them.

Mitsuba refuses reflectances above one, and its mixture (see `factorlib.export.mitsuba`) needs max k_d + max k_s ≤ 1 −
1e-5 of every material.  Only the product of reflectance and light is known.  If a material exceeds the limit, one
factor for the whole set moves from all reflectances into all lights.  Every material then keeps its radiance in every
light, also across photos that share nothing.
"""

from collections.abc import Mapping

import msgspec

from factorlib.results.materials import MaterialTable, Reflectance, Solved, StandardErrors

HEADROOM = 1e-5
RULE = (
    "where max diffuse + max specular of a material exceeds 1 - 1e-5, "
    "one factor moves from all reflectances to all lights"
)


def headroom_factor(materials: Mapping[str, Reflectance]) -> float:
    """Return the factor that brings all reflectances within the limit; 1 if they already are.

    >>> headroom_factor({"red": Reflectance((0.9, 0.1, 0.1), (0.1, 0.1, 0.3), 0.3)})
    0.8333250000000001
    """
    brightest = max((m.total for m in materials.values()), default=0.0)
    limit = 1 - HEADROOM
    return 1.0 if brightest <= limit else limit / brightest


def table_in_gauge(table: MaterialTable, factor: float) -> MaterialTable:
    """Return the table with reflectances and standard errors times `factor`, which `gauge` records."""
    gauge = msgspec.structs.replace(table.gauge, export_factor=factor, export_rule=RULE)

    def scaled(values: Solved | StandardErrors) -> Solved | StandardErrors:
        """Return the diffuse and specular values times the factor."""
        diffuse, specular = (tuple(factor * v for v in colour) for colour in (values.diffuse, values.specular))
        return msgspec.structs.replace(values, diffuse=diffuse, specular=specular)

    materials = {n: msgspec.structs.replace(scaled(m), stderr=scaled(m.stderr)) for n, m in table.materials.items()}
    return msgspec.structs.replace(table, materials=materials, gauge=gauge)
