"""What keeps the default run short: a small network, and sweeps of which all cases but a few are slow."""

import pytest

SLOW = pytest.mark.slow
#: Sizes of a network for tests that do not ask how well it learns: half the kernels' code of the default sizes.
NETWORK = {"levels": 4, "hashmap_size": 2**12, "width": 16}


def sweep(cases, default) -> list:
    """`cases` for ``pytest.mark.parametrize``, tuples where it names several arguments. Those not in `default` are
    slow.

    `default` holds one case of each kind, so that the default run asserts the fact; `pytest -m slow` has the others.
    """
    cases, default = list(cases), list(default)
    assert all(case in cases for case in default), "a default case that is none"
    return [case if case in default else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=SLOW)
            for case in cases]  # fmt: skip
