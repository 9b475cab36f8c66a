"""How far a solve is: it never goes back, and says all only at the end."""

from factorlib.solve.history import PHASES, Event, of_parts
from factorlib.solve.options import Choices


def test_progress_never_goes_back_and_is_whole_only_at_the_end():
    """With three starts each model is fitted three times: the first phases are entered anew."""
    said = []
    report = of_parts(lambda done, total, text: said.append(done / total), Choices(splittings=2))
    for phase in [*(one for one in PHASES[:3] for _ in range(3)), *PHASES[3:], "splitting 1", "splitting 2", "lights"]:
        for iteration in (0, 10, 40, -1):
            report(Event(0, phase, iteration, 1.0, float("nan"), 400))
        if phase == PHASES[-1]:
            assert 0.5 < said[-1] < 0.7
    assert said == sorted(said) and 0 < said[1] < 0.1 and 0.99 < said[-1] < 1
