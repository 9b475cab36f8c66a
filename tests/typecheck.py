"""What checks the types of every call in the tests: shapes by jaxtyping, all else by beartype, an int being a float too."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
