"""Grids of runs: nested overrides, axes and launchers, valid or not: only documented errors."""

import pytest
from hypothesis import strategies as st

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.plan import BenchmarkConfig
from tests.fuzz.values import JSON, changed, check, examples
from tests.training.grid.grids import REACH, planned


def overrides(*names):
    """By name of a task, an algorithm or a network, overrides at any depth."""
    fields = ExperimentConfig.model_fields.keys() - {"plugins"}
    inside = st.one_of(
        changed(fields),
        changed(EnvConfig.model_fields).map(lambda values: {"env": values}),
        changed(ALGORITHMS["sac"].model_fields).map(lambda values: {"algorithm": values}),
        changed(NETWORKS["cnn"].model_fields).map(lambda values: {"network": values}),
        JSON,
    )
    return st.dictionaries(
        st.one_of(st.sampled_from(names), st.text(max_size=4)), inside, min_size=1, max_size=2
    )


CHANGES = st.one_of(
    changed(BenchmarkConfig.model_fields),
    st.fixed_dictionaries({"per_task": overrides(REACH)}),
    st.fixed_dictionaries({"per_algorithm": overrides("sac")}),
    st.fixed_dictionaries({"per_network": overrides("small")}),
    st.fixed_dictionaries(
        {"launcher": st.dictionaries(st.sampled_from(["name", "gpus"]), JSON, max_size=2)}
    ),
)


@examples(15)
def test_grids(tmp_path, count):
    def prop(changes):
        try:
            runs = planned(tmp_path, **{"seeds": 1, **changes})
        except ConfigError:
            return  # documented
        assert runs
        assert len({run.run_dir for run in runs}) == len(runs)

    check(count, CHANGES, prop)


@pytest.mark.parametrize(
    "override",
    [{"env": 3}, {"env": {"obs_size": {"a": 1}}}, {"algorithm": []}, {"network": {"width": None}}],
)
def test_an_override_of_the_wrong_shape_is_a_configuration_error(tmp_path, override):
    with pytest.raises(ConfigError):
        planned(tmp_path, per_task={REACH: override})
