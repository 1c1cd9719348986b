"""Strategies of values, and the number of examples of each property."""

import pytest
from hypothesis import HealthCheck, Phase, given, settings, strategies as st

MANY = 2000

NUMBERS = st.one_of(
    st.integers(-3, 40),
    st.integers(),
    st.floats(),
    st.floats(-2, 2),
    st.sampled_from([1e30, -1e-30, 2**31, 2**63, -1]),
)
SCALARS = st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=6))
JSON = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)
PLUGINS = st.lists(
    st.one_of(st.just("no_such_module"), st.text(alphabet="ab.-_ /\0é", max_size=6)), max_size=2
)


def examples(few):
    """Parametrize a test by its number of examples: ``few``, and `MANY` with the marker slow."""
    return pytest.mark.parametrize("count", [few, pytest.param(MANY, marks=pytest.mark.slow)])


def check(count, strategy, prop, shrinks=True):
    """Check that a property holds for ``count`` values of a strategy, the same in every run."""

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate, Phase.shrink] if shrinks else [Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def run(value):
        prop(value)

    run()


def changed(fields, *, values=JSON, most=3):
    """Dictionaries of some fields, valid or not, and now and then an unknown one."""
    names = st.one_of(st.sampled_from(sorted(fields)), st.text(max_size=8))
    return st.dictionaries(names, values, max_size=most)
