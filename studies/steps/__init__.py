"""Steps of studies, a module each, as `stages/` are those of the pipeline; `studies/run/pipeline.yaml` joins them.

worlds, solve, score   sets of observations whose truth is known
compare                methods that see the same photos
rendered_sets, parts   rendered data sets, and parts of the model switched off
"""

import msgspec


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Empty parameters: the case sets everything."""
