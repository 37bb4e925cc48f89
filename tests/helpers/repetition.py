"""Parameters of tests that say the same again: few values in the quick suite, all of them in the slow one."""

import pytest


def slow_after(count, values):
    """The values as parameters, those after the first ``count`` marked slow."""
    return [
        value if k < count else pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.slow)
        for k, value in enumerate(values)
    ]
