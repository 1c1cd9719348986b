import json

import pytest
from omegaconf import OmegaConf
from tensordict import TensorDict

import ba_torchrl
from ba_torchrl.algorithms.config import ALGORITHMS
from ba_torchrl.core.config import TaskParameters, parse
from ba_torchrl.core.env_config import EnvConfig, env_config_model
from ba_torchrl.core.errors import ConfigError, UnknownNameError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.core.registry import Registry
from ba_torchrl.data import RigidAugmentation, as_transitions, make_replay
from ba_torchrl.demonstrations.formats.base import FORMATS
from ba_torchrl.envs.observations import OBSERVATIONS
from ba_torchrl.modules.base import NETWORKS
from ba_torchrl.objectives import BehaviourCloningLoss, LevelDQNLoss
from ba_torchrl.tasks.base import TASKS


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"max_steps": "10"}, "max_steps: must be a whole number .got '10'"),
        ({"max_steps": 0}, "max_steps: must be at least 1"),
        ({"random_orientation": 1}, "random_orientation: must be true or false"),
        ({"obs_size": 4}, "obs_size"),
        ({"workspace": [0.3, 0.6]}, "three .low, high. pairs"),
        ({"workspace": [[0.6, 0.3], [-0.1, 0.1], [0, 1]]}, "low < high"),
        ({"workspace": ["01", "12", "23"]}, "three .low, high. pairs of numbers"),
        ({"workspace": [[False, True]] * 3}, "three .low, high. pairs of numbers"),
        ({"object_scale_range": ["0.6", "0.7"]}, "a number or a .low, high. pair"),
        ({"object_scale_range": {0.6, 0.7}}, "a number or a .low, high. pair"),
        ({"object_scale_range": [True, True]}, "a number or a .low, high. pair"),
        ({"floor_color": "101"}, "red, green and blue"),
        ({"floor_color": [True, False, True]}, "red, green and blue"),
        ({"object_scale_range": [1.2, 0.8]}, "low <= high"),
        ({"object_scale_range": True}, "a number or a"),
        ({"workspace_check": "box"}, "bounding_box"),
        ({"dpos": 0.0}, "dpos"),
        ({"observations": "proprio"}, "observations: must be a list"),
    ],
)
def test_wrong_values_say_what_is_allowed(values, message):
    with pytest.raises(ConfigError, match=message):
        parse(EnvConfig, values, "configuration")


class Sequences(TaskParameters):
    sizes: tuple[tuple[float, float], ...] = ((1.0, 2.0),)
    vector_keys: tuple[str, ...] = ()
    names: list[str] = []  # noqa: RUF012 -- pydantic copies it
    by_name: dict[str, tuple[int, ...] | None] = {}  # noqa: RUF012


@pytest.mark.parametrize("model", [Sequences, env_config_model(Sequences)])
def test_lists_and_tuples_are_what_the_types_ask_for(model):
    given = {"sizes": [[3.0, 4.0]], "vector_keys": ["a"], "names": ("b",), "by_name": {"c": [1]}}
    config = parse(model, given, "c")
    assert config.sizes == ((3.0, 4.0),)
    assert config.vector_keys == ("a",)
    assert config.names == ["b"]
    assert config.by_name == {"c": (1,)}
    for each in (config, model()):
        assert parse(model, json.loads(each.model_dump_json()), "c") == each
        values = OmegaConf.to_container(OmegaConf.create(each.model_dump()))  # as Hydra composes
        assert parse(model, values, "c") == each


@pytest.mark.parametrize(
    "values",
    [
        {"vector_keys": "ab"},
        {"names": "ab"},
        {"vector_keys": [1]},
        {"sizes": [[1.0]]},
        {"names": 1},
    ],
)
def test_sequences_remain_strict(values):
    (name,) = values
    with pytest.raises(ConfigError, match=rf"\n  {name}"):
        parse(Sequences, values, "c")


def test_a_parameter_of_a_task_cannot_repeat_one_of_every_environment():
    class Parameters(TaskParameters):
        max_steps: int = 3

    with pytest.raises(TypeError, match=r"Parameters repeats .*: max_steps"):
        env_config_model(Parameters)


@pytest.mark.parametrize(("given", "pair"), [(0.6, (0.6, 0.6)), ([0.6, 0.7], (0.6, 0.7))])
def test_scale_takes_a_number_or_a_pair(given, pair):
    assert parse(EnvConfig, {"object_scale_range": given}, "c").object_scale_range == pair


PICKING = "close_loop/block_picking"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_step": 3}, r"Did you mean 'max_steps'\?$"),
        ({"task": "close_loop/block_pickin"}, PICKING),
        ({"robot": "baxter"}, "Known: .*kuka"),
        *(
            ({"action_sequence": sequence}, "close-loop")
            for sequence in ("pxy", "pxyzrr", "xyz", "pxyzq", "ppxyz")
        ),
        ({"workspace": [[0.5, 1.2], [-0.3, 0.3], [0.01, 0.25]]}, "cannot reach"),
        ({"workspace": [[0.4, 0.5], [-0.05, 0.05], [0.01, 0.25]]}, "enlarge `workspace`"),
    ],
)
def test_settings_that_make_no_environment_are_refused(settings, message):
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        ba_torchrl.make(**{"task": PICKING, **settings})


def test_registry_refuses_two_entries_of_one_name():
    registry: Registry[object] = Registry("thing", "ba_torchrl.tasks.close_loop")
    registry.register("a")(1)
    with pytest.raises(ConfigError, match=r"two things are named 'a'.*another name in tests\."):
        registry.register("a")(2)
    with pytest.raises(UnknownNameError, match="unknown thing 'b'"):
        registry["b"]


@pytest.mark.parametrize("registry", [TASKS, NETWORKS, ALGORITHMS, OBSERVATIONS, FORMATS])
def test_registry_refuses_what_does_not_derive_from_its_base(registry):
    with pytest.raises(ConfigError, match=rf"{registry.kind} 'mine/x': .* derive from ba_torchrl"):
        registry.register("mine/x")(type("X", (), {}))
    assert "mine/x" not in registry


@pytest.mark.parametrize("name", [object, "", 3, "mine/my task"])
def test_registry_refuses_what_is_no_name(name):
    with pytest.raises(ConfigError, match="register takes a name such as 'mine/thing'"):
        Registry("thing", "ba_torchrl.tasks.close_loop").register(name)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ImageSpec(1, 16, 1.0, frame="world"), "frame is one of 'scene', .*, not 'world'"),
        (lambda: ImageSpec(1, 16, "1"), "range of an image: must be finite numbers low < high"),
        (lambda: ImageSpec(1, 16, True, False), "range of an image: must be finite numbers"),
        (lambda: ImageSpec(1, 16, 0.0), "range of an image: must be finite numbers low < high"),
        (lambda: ImageSpec(1, 16, 1.0, storage="int8"), "storage is one of 'uint8', "),
        (lambda: make_replay("per", 8, 2, codecs={}, seed=0), "kind is one of 'uniform', "),
        (lambda: RigidAugmentation("c4", None, {}, seed=0), "transforms is one of 'translation'"),
        (
            lambda: as_transitions(TensorDict(), [], is_demonstration=True, imitates="all"),
            "imitates is one of 'none', ",
        ),
        (lambda: BehaviourCloningLoss(None, distance="l1"), "distance is one of 'mse', 'kl'"),
        (lambda: LevelDQNLoss(None, demonstrations="dqn"), "demonstrations is one of 'none', "),
        (lambda: ba_torchrl.load_policy("x/y", which="last"), "which is one of 'best', 'latest'"),
    ],
)
def test_a_misspelt_choice_is_not_taken_for_another(call, message):
    with pytest.raises(ConfigError, match=message):
        call()
