"""What TorchRL's own tests ask of each of its losses, asked of each of ours."""

import copy
import dataclasses
import re

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, QValueActor, TanhNormal
from torchrl.objectives import HardUpdate, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from ba_torchrl.core import keys
from ba_torchrl.core.errors import BatchError
from ba_torchrl.modules.chunks import ChunkFlow, ChunkHead
from ba_torchrl.modules.spatial.policy import SpatialValues
from ba_torchrl.objectives import (
    BehaviourCloningLoss,
    FlowMatchingLoss,
    LevelCrossEntropyLoss,
    LevelDQNLoss,
    RLPDLoss,
    SACfDLoss,
)
from ba_torchrl.objectives.iql import EvalModeTargetsIQLLoss
from tests.level_tables import ACTIONS, Tables, batch as level_batch
from tests.linear_sac import LinearCritics, LinearEncoder, LinearPolicy, batch as continuous_batch

OBSERVATION = [keys.DEPTH, keys.HOLDING]


def policy():
    module = TensorDictModule(LinearPolicy(), OBSERVATION, ["loc", "scale"])
    return ProbabilisticActor(module, ["loc", "scale"], distribution_class=TanhNormal)


class Value(nn.Module):
    """A value of a state or of an action."""

    def __init__(self, inputs):
        super().__init__()
        self.net = nn.Linear(inputs, 1)

    def forward(self, *inputs):
        return self.net(torch.cat([each.to(self.net.weight) for each in inputs], dim=-1))


def sac(kind, critics, **options):
    encoder = TensorDictModule(LinearEncoder(), OBSERVATION, ["features"])
    critic = TensorDictModule(
        LinearCritics(critics), ["features", keys.ACTION], ["state_action_value"]
    )
    return kind(policy(), encoder, critic, **options)


def iql(**options):
    inputs, out = [*OBSERVATION, keys.ACTION], ["state_action_value"]
    critics = [TensorDictModule(Value(5), inputs, out) for _ in range(2)]
    value = TensorDictModule(Value(3), OBSERVATION, ["state_value"])
    if options.get("reduction") == "none":
        options["scalar_output_mode"] = "exclude"
    loss = EvalModeTargetsIQLLoss(policy(), critics, value, **options)
    loss.make_value_estimator()
    return loss


def actor(action_space):
    network = nn.Sequential(nn.Linear(9, 6), nn.Tanh(), nn.Linear(6, 5))
    return QValueActor(network, in_keys=["heights"], action_space=action_space)


def discrete_batch(size=20, action_space="categorical"):
    data = level_batch(size, experts="all").exclude("chosen")
    for state in (data, data[keys.NEXT]):
        state["heights"] = state.pop("heightmap").flatten(1)
        del state["in_hand"], state["holding"]
    action = torch.randint(5, (size,), generator=torch.Generator().manual_seed(3))
    return data.set("action", nn.functional.one_hot(action, 5) if action_space else action)


def in_type(data, dtype):
    return data.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)


def continuous():
    data = torch.cat([in_type(continuous_batch((True,) * 4, weights=None), torch.float32)] * 5)
    noise = torch.randn(20, 2, generator=torch.Generator().manual_seed(0))
    return data.set(keys.DEPTH, data[keys.DEPTH] + noise)


def levels(**options):
    return LevelDQNLoss(SpatialValues(Tables(), ACTIONS), **options)


def flow(**options):
    head = ChunkHead(4, torch.eye(2)[None], torch.zeros(1, 0, 0), horizon=4, hidden=8)
    network = ChunkFlow(LinearEncoder(), head)
    network = TensorDictModule(network, [*OBSERVATION, keys.NOISE], [keys.ACTION_CHUNK])
    return FlowMatchingLoss(network, **options)


def chunks():
    data = continuous()
    chunk = torch.rand(20, 4, 2, generator=torch.Generator().manual_seed(2))
    is_valid = torch.arange(20)[:, None] % 5 + torch.arange(4) < 5
    return data.set(keys.TARGET_CHUNK, chunk).set(keys.TARGET_CHUNK_MASK, is_valid)


def sets(size=20):
    data = level_batch(size).exclude("chosen")
    return data.set("action", torch.stack([data["action"], data["action"].roll(1, 0)], dim=1))


LOSSES = {
    "sacfd": (lambda **options: sac(SACfDLoss, 2, **options), continuous),
    "rlpd": (lambda **options: sac(RLPDLoss, 3, subset=3, **options), continuous),
    "level_dqn": (levels, lambda: level_batch(20, experts="all").exclude("chosen")),
    "double": (
        lambda **options: levels(double_dqn=True, demonstrations="dqfd", **options),
        lambda: level_batch(20, experts="all").exclude("chosen"),
    ),
    "categorical": (
        lambda **options: LevelDQNLoss(actor("categorical"), **options),
        lambda: discrete_batch(action_space=None),
    ),
    "one_hot": (lambda **options: LevelDQNLoss(actor("one_hot"), **options), discrete_batch),
    "bc": (
        lambda **options: BehaviourCloningLoss(policy(), entropy_weight=0.1, **options),
        continuous,
    ),
    "level_cross_entropy": (
        lambda **options: LevelCrossEntropyLoss(SpatialValues(Tables(), ACTIONS), **options),
        lambda: level_batch(20).exclude("chosen"),
    ),
    "sets": (
        lambda **options: LevelCrossEntropyLoss(
            SpatialValues(Tables(), ACTIONS), of_sets=True, **options
        ),
        sets,
    ),
    "cross_entropy": (
        lambda **options: LevelCrossEntropyLoss(actor("categorical"), **options),
        lambda: discrete_batch(action_space=None),
    ),
    "flow": (flow, chunks),
    "iql": (iql, continuous),
}
OURS = [name for name in LOSSES if name != "iql"]
"""Without the loss whose calculation is TorchRL's."""
TRAINED_BY_TARGETS = ["sacfd", "rlpd", "level_dqn", "double", "categorical", "one_hot", "iql"]
every_loss = pytest.mark.parametrize("name", LOSSES)
each_of_ours = pytest.mark.parametrize("name", OURS)


def make(name, seed=0, **options):
    torch.manual_seed(seed)
    loss = LOSSES[name][0](**options)
    if name in TRAINED_BY_TARGETS:
        SoftUpdate(loss, tau=0.1)  # without one, TorchRL warns
    return loss


def data_of(name):
    return LOSSES[name][1]()


def called(loss, data):
    torch.manual_seed(7)
    return loss(data)


def is_of_target(key):
    return key.startswith("target_") and "_params." in key


def terms(out):
    return {key: value for key, value in out.items() if key.startswith("loss_")}


@each_of_ours
def test_every_key_can_be_set_and_set_back(name):
    loss = make(name)
    for field in dataclasses.fields(loss._AcceptedKeys):
        before = getattr(loss.tensor_keys, field.name)
        loss.set_keys(**{field.name: ("some", "entry")})
        assert getattr(loss.tensor_keys, field.name) == ("some", "entry")
        loss.set_keys(**{field.name: None})
        assert getattr(loss.tensor_keys, field.name) == before
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(colour="red")


@each_of_ours
def test_in_keys_are_what_a_loss_needs_and_out_keys_what_it_returns(name):
    loss, data = make(name), data_of(name)
    out = called(loss, data.select(*loss.in_keys))
    assert set(out.keys()) == set(loss.out_keys)
    assert out.batch_size == ()
    names = {"_".join([key] if isinstance(key, str) else key): key for key in loss.in_keys}
    torch.manual_seed(7)
    by_name = loss(**{name: data[key] for name, key in names.items()})
    by_name = by_name if isinstance(by_name, tuple) else (by_name,)
    for key, value in zip(loss.out_keys, by_name, strict=True):
        torch.testing.assert_close(value, out[key])
    chosen = loss.out_keys[0]
    loss.select_out_keys(chosen)
    assert torch.equal(called(loss, data)[chosen], out[chosen])


@each_of_ours
def test_a_batch_that_lacks_an_entry_or_is_empty_is_refused(name):
    loss, data = make(name), data_of(name)
    either = {(keys.NEXT, keys.DONE), (keys.NEXT, keys.TERMINATED)}  # stands for the other
    for key in loss.in_keys:
        if key in either:
            loss(data.exclude(key))
            continue
        message = f"{type(loss).__name__}: the batch lacks {key!r}; it has "
        with pytest.raises(BatchError, match=re.escape(message)):
            loss(data.exclude(key))
    with pytest.raises(BatchError, match="the batch is empty"):
        loss(data[:0])


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ((keys.NEXT, keys.REWARD), lambda value: value[:, 0], r"float32\[20\], and must"),
        ((keys.NEXT, keys.TERMINATED), lambda value: value[:, 0], r"must be bool\[20, 1\]"),
        ((keys.NEXT, keys.TERMINATED), lambda value: value.long(), r"int64\[20, 1\], and must be"),
        (keys.IS_DEMONSTRATION, lambda value: value.float(), r"bool\[20, 1\] or bool\[20\]"),
    ],
)
@pytest.mark.parametrize("name", ["sacfd", "level_dqn", "one_hot"])
def test_transitions_of_other_types_and_shapes_are_refused(name, key, change, message):
    data = data_of(name)
    with pytest.raises(BatchError, match=message):
        make(name)(data.set(key, change(data[key])))


@pytest.mark.parametrize(
    ("name", "key", "change", "message"),
    [
        (
            "sacfd",
            keys.ACTION,
            lambda value: value[:, :1],
            r"float32\[20, 1\], and must",
        ),
        ("sacfd", keys.ACTION, torch.Tensor.double, r"float64\[20, 2\], and must be float32"),
        ("bc", keys.ACTION, lambda value: value[:, :1], "have 2 components, and the expert's 1"),
        ("level_dqn", keys.ACTION, lambda value: value[:, 1:], "one per letter of 'pxyzrrr'"),
        ("sets", keys.ACTION, lambda value: value[:, 0], "must have 3 dimensions, 2 after"),
        ("categorical", keys.ACTION, lambda value: value[:, None].expand(-1, 5), "categorical"),
        ("one_hot", keys.ACTION, lambda value: value[:, :1], r"must be \[20, 5\] .* one-hot"),
        ("flow", keys.TARGET_CHUNK, lambda value: value[:, 0], "must have 3 dimensions, 2 after"),
        ("flow", keys.TARGET_CHUNK, lambda value: value[..., :1], r"must be float32\[4, 2\] for"),
        ("flow", keys.TARGET_CHUNK, torch.Tensor.double, r"must be float32\[4, 2\] for each"),
        ("flow", keys.TARGET_CHUNK_MASK, lambda value: value[:, :1], r"must be bool\[20, 4\]"),
    ],
)
def test_actions_of_other_types_and_shapes_are_refused(name, key, change, message):
    data = data_of(name)
    with pytest.raises(BatchError, match=message):
        make(name)(data.set(key, change(data[key])))


@every_loss
def test_a_loss_changes_no_entry_of_its_batch_and_repeats_itself(name):
    loss, data = make(name), data_of(name)
    before = data.clone()
    first = called(loss, data)
    torch.testing.assert_close(
        dict(data.select(*before.keys(True, True)).items(True, True)),
        dict(before.items(True, True)),
    )
    with torch.no_grad():
        again = called(loss, data)
    for key, value in first.items():
        torch.testing.assert_close(again[key], value.detach())


@every_loss
def test_reductions_are_the_losses_of_samples_their_mean_and_their_sum(name):
    data = data_of(name)
    kinds = ("none", "mean", "sum", None)
    found = {kind: called(make(name, reduction=kind), data) for kind in kinds}
    for key, losses in terms(found["none"]).items():
        assert losses.shape == (20,)
        torch.testing.assert_close(found["mean"][key], losses.mean())
        torch.testing.assert_close(found["sum"][key], losses.sum())
        assert torch.equal(found[None][key], found["mean"][key])
    if name in OURS:
        for key in found["mean"].keys() - terms(found["mean"]).keys():
            torch.testing.assert_close(found["none"][key], found["mean"][key])
    with pytest.raises((ValueError, NotImplementedError), match=r"reduction.*median"):
        make(name, reduction="median")(data)


@each_of_ours
@pytest.mark.parametrize("reduction", ["none", "mean"])
@pytest.mark.parametrize("shape", [(4, 5), (1, 20), ()])
def test_a_batch_has_any_shape(name, shape, reduction):
    loss = make(name, reduction=reduction)
    data = data_of(name)[: None if shape else 1]
    expected = called(loss, data)
    shaped = data_of(name).reshape(shape) if shape else data_of(name)[0]
    found = called(loss, shaped)
    assert shaped.batch_size == shape
    for key, value in expected.items():
        is_of_samples = reduction == "none" and key.startswith("loss_")
        torch.testing.assert_close(found[key], value.reshape(shape) if is_of_samples else value)
    if keys.TD_ERROR in data:
        assert torch.equal(shaped[keys.TD_ERROR], data[keys.TD_ERROR].reshape(*shape, 1))


@every_loss
def test_each_parameter_has_a_gradient_and_no_target_has(name):
    loss, data = make(name), data_of(name)
    sum(terms(called(loss, data)).values()).backward()
    for parameter in loss.parameters():
        assert parameter.grad.isfinite().all()
        assert parameter.grad.any()
    targets = [key for key, _ in loss.named_buffers() if is_of_target(key)]
    assert bool(targets) == (name in TRAINED_BY_TARGETS)
    assert not any(buffer.requires_grad for buffer in loss.buffers())


@each_of_ours
@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_an_ensemble_is_computed_by_one_vmap(name):
    loss, data = make(name), data_of(name)
    params = [TensorDict.from_module(each).data.clone() for each in (make(name, seed=1), loss)]

    def total(params):
        with params.to_module(loss):
            return sum(terms(loss(data.clone())).values())

    torch.manual_seed(7)
    found = torch.vmap(total, randomness="same")(torch.stack(params))
    expected = [sum(terms(called(make(name, seed), data)).values()) for seed in (1, 0)]
    torch.testing.assert_close(found, torch.stack(expected))


@every_loss
def test_states_copies_and_pickles_compute_the_same(name):
    loss, data = make(name), data_of(name)
    expected = dict(called(loss, data))
    other = make(name, seed=1)
    other.load_state_dict(loss.state_dict())
    for each in (other, copy.deepcopy(loss)):
        torch.testing.assert_close(dict(called(each, data)), expected)


@every_loss
def test_parameters_are_reset(name, recwarn):
    loss = make(name)
    drawn = {key: "params" in key and "frames" not in key for key in loss.state_dict()}
    before = {key: value.clone() for key, value in loss.state_dict().items() if drawn[key]}
    with torch.no_grad():
        for value in (*loss.parameters(), *loss.buffers()):
            value.add_(1000)
    torch.manual_seed(2)
    loss.reset_parameters_recursive()
    assert [str(each.message) for each in recwarn] == []
    for key, value in before.items():
        after = loss.state_dict()[key]
        assert not torch.equal(after, value)
        assert after.abs().max() < 100


def test_a_reset_names_the_modules_that_it_cannot_reset(monkeypatch):
    monkeypatch.delattr(LinearPolicy, "reset_parameters")
    with pytest.warns(UserWarning, match="^LinearPolicy: parameters kept, without reset"):
        make("bc").reset_parameters_recursive()


@pytest.mark.parametrize(
    ("make_loss", "message"),
    [
        (lambda: flow(draws=0), "draws must be at least 1, got 0"),
        (lambda: sac(RLPDLoss, 3, subset=0), "subset must be at least 1, got 0"),
        (lambda: levels(margin=-0.1), "margin must not be negative, got -0.1"),
        (
            lambda: SACfDLoss(LinearPolicy(), LinearEncoder(), LinearCritics(2)),
            "actor_network is a LinearPolicy, without .*: pass a ProbabilisticActor",
        ),
        (
            lambda: SACfDLoss(policy(), LinearEncoder(), LinearCritics(2)),
            r"encoder_network is a LinearEncoder, without .*: pass TensorDictModule\(",
        ),
        (lambda: BehaviourCloningLoss(LinearPolicy()), "pass a ProbabilisticActor"),
        (lambda: LevelDQNLoss(Tables()), r"pass a QValueActor, or SpatialValues\("),
        (lambda: FlowMatchingLoss(policy()), r"pass TensorDictModule\(ChunkFlow\("),
    ],
)
def test_arguments_without_a_meaning_are_refused(make_loss, message):
    with pytest.raises(ValueError, match=message):
        make_loss()


@every_loss
def test_a_loss_computes_in_the_type_of_its_parameters(name):
    loss, data = make(name).double(), in_type(data_of(name), torch.float64)
    for key, value in terms(called(loss, data)).items():
        assert value.dtype == torch.float64, key


@pytest.mark.parametrize("name", TRAINED_BY_TARGETS)
def test_targets_follow(name):
    loss = make(name)
    targets = {key: value for key, value in loss.named_buffers() if is_of_target(key)}
    assert targets
    online = dict(loss.named_parameters())
    with torch.no_grad():
        for value in online.values():
            value.add_(1)
    HardUpdate(loss, value_network_update_interval=0).step()
    for key, value in targets.items():
        assert torch.equal(value, online[key.removeprefix("target_")])


@pytest.mark.parametrize("name", [name for name in TRAINED_BY_TARGETS if name != "iql"])
def test_value_estimators_and_their_keys(name):
    data, loss = data_of(name), make(name)
    estimator = TD0Estimator(gamma=0.5, value_network=None)
    found = []
    for arguments in (
        ((), {"gamma": 0.5}),
        ((ValueEstimators.TD0,), {"gamma": 0.5}),
        ((TD0Estimator,), {"gamma": 0.5, "value_network": None}),
        ((estimator,), {}),
    ):
        assert loss.make_value_estimator(*arguments[0], **arguments[1]) is loss
        found.append(dict(called(loss, data)))
        torch.testing.assert_close(found[-1], found[0])
    for unsupported in (ValueEstimators.TDLambda, ValueEstimators.GAE):
        with pytest.raises(NotImplementedError):
            loss.make_value_estimator(unsupported)
    renamed = make(name)
    renamed.set_keys(reward="gain")  # before the estimator, and the others after it
    renamed.make_value_estimator(gamma=0.5)
    renamed.set_keys(done="over", terminated="lost", is_demonstration=("of", "expert"))
    other = data.clone()
    for old, new in {"reward": "gain", "done": "over", "terminated": "lost"}.items():
        other[keys.NEXT].rename_key_(old, new)
    other.rename_key_(keys.IS_DEMONSTRATION, ("of", "expert"))
    assert {("next", "gain"), ("next", "over"), ("next", "lost")} <= set(renamed.in_keys)
    torch.testing.assert_close(dict(called(renamed, other)), found[0])
