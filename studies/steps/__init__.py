"""Steps of studies, a module each, as `stages/` are those of the pipeline; `studies/run/pipeline.yaml` joins them.

worlds, solve, score   sets of observations whose truth is known
answer, compare        the comparison of methods
photos                 data sets of photos, rendered or the checkout's own, as far as observations
parts, chairs          parts switched off; chairs left out
"""

import msgspec


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the case says all."""
