"""Steps of studies, a module each, as `stages/` are those of the pipeline; `studies/run/pipeline.yaml` joins them.

worlds, observe, solve, score    sets of observations whose truth is known
optimise, compare                the comparison of methods
sets, photos                     data sets of photos, rendered or the checkout's own, as far as observations
parts; whole, leave_out, chairs  parts switched off; chairs left out
"""

from __future__ import annotations

import msgspec


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the case says all."""
