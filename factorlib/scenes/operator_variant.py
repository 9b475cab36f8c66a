"""Variants of the reflection operators, by precision and with or without compiled code, for tests and studies."""

import os
from unittest.mock import patch

from factorlib.errors import InputError
from factorlib.reflection import Name, Operator, reflection_operator


def operator_variant(name: Name, dtype: str, *, compiled: bool = True) -> Operator | None:
    """Return an operator in a precision, with or without its compiled code; None if it has no such variant."""
    with patch.dict(os.environ, {} if compiled else {"FACTORLIB_FUSED": "0"}):
        try:
            operator = reflection_operator(name, dtype=dtype)
        except InputError:
            return None
    return operator if compiled or hasattr(operator, "fused") else None
