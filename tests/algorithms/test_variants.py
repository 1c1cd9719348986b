"""Presets of algorithms with networks: two updates on small networks; what options build."""

import copy
import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.algorithms.sac import SAC
from ba_torchrl.core import keys
from ba_torchrl.core.config import parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.data.augmentation.so2 import SO2Augmentation, StoredCopies
from ba_torchrl.data.augmentation.views import RandomViews
from ba_torchrl.objectives.sacfd import SoftUpdateByNetwork
from ba_torchrl.training.presets import preset, started
from tests.algorithms import tiny
from tests.specs import close_loop_images

CONFIGS = Path(__file__).parents[2] / "configs"
NETWORK_NAMES = [*tiny.SIZES, "6d_asr"]
"""Networks; "6d_asr" is "asr" for actions in six degrees of freedom."""
IMAGE, CROP = 71, 64


@cache
def method(name):
    """The values of a method, composed of presets."""
    with started(CONFIGS):
        return preset("algorithm", name)


PAIRS = {
    "adet": "equi_fcn",
    "bc": "6d_asr",
    "dagger": "equi_deictic_asr",
    "dqfd": "rot_fcn",
    "dqn": "fcn",
    "drq": "equi",
    "ferm": "ferm",
    "flow": "equi",
    "flow_dagger": "ferm",
    "ferm_per": "ferm",
    "iql": "equi",
    "rad": "cnn",
    "rlpd": "cnn",
    "sac": "cnn",
    "sacfd": "equi",
    "sacfd_per_so2": "cnn",
    "sdqfd": "equi_asr",
}
"""By preset, the network of the quick tests; slow tests take all that fit."""
PRESETS = sorted(path.stem for path in (CONFIGS / "algorithm").glob("*.yaml"))


def build(preset, network, first=0, **changes):
    """A learner; of FERM, with some first updates of the contrastive loss alone."""
    values = {**method(preset), **changes, "batch_size": 4}
    values["replay"] = {**values.get("replay", {}), "capacity": 60}
    sequence = tiny.SIX_DOF if network == "6d_asr" else None
    network = network.removeprefix("6d_")
    problem = tiny.problem(network, sequence)
    if values.get("contrastive", {}).get("name") == "info_nce":
        values["contrastive"] = {**values["contrastive"], "updates": first}
    if values.get("views", {}).get("name") == "crop":
        values["views"] = {**values["views"], "size": CROP}
        problem = replace(problem, images=close_loop_images(IMAGE))
    return tiny.build(values.pop("name"), network, sequence=sequence, on=problem, **values)


def transitions(algorithm):
    """Eight random transitions, every second one a demonstration."""
    return tiny.transitions(algorithm, 8)


def parameters(algorithm):
    return {name: p.detach().clone() for name, p in algorithm.loss.named_parameters()}


@pytest.mark.parametrize("preset", sorted({*PRESETS, *PAIRS}))
def test_two_updates_change_every_network(preset):
    check_two_updates(preset, PAIRS[preset])


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("network", NETWORK_NAMES)
def test_two_updates_change_every_network_with_every_preset(preset, network):
    control = NETWORKS[network.removeprefix("6d_")].control
    if control not in ALGORITHMS[method(preset)["name"]].controls:
        pytest.skip("a network of the other control")
    if (preset, network) == ("rlpd", "ferm"):
        pytest.skip("it builds no ensemble of critics")
    check_two_updates(preset, network)


def check_two_updates(preset, network):
    algorithm = build(preset, network)
    algorithm.extend(transitions(algorithm))
    before = parameters(algorithm)
    for _ in range(2):
        scalars = algorithm.update()
    assert algorithm.updates == 2
    assert all(torch.isfinite(value).all() for value in scalars.values())
    after = parameters(algorithm)
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    parts = [{name.split("_params")[0] for name in names} for names in (changed, after)]
    assert parts[0] == parts[1]
    if algorithm.problem.control == "close_loop":  # all convolutions see every image
        convolutions = {name for name in after if ".convs." in name}
        assert convolutions
        assert convolutions <= changed
    state = transitions(algorithm).select(*algorithm.policy.in_keys)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert algorithm.policy(state)[keys.ACTION].isfinite().all()


def test_the_options_reach_augmentation_loss_and_target_update():
    drq = build("drq", "cnn", views={"name": "shift", "pixels": 3, "views": 3, "target_views": 2})
    (augmentation,) = drq.replay.transform
    assert isinstance(augmentation, RandomViews)
    assert (augmentation.padding, augmentation.views, augmentation.target_views) == (3, 3, 2)
    assert (drq.loss.views, drq.loss.target_views) == (3, 2)
    assert drq.loss.contrastive is None
    ferm = build("ferm", "ferm", encoder_tau=0.2, tau=0.1)
    assert ferm.replay.transform[0].has_positive
    assert ferm.replay.transform[0].padding == 0
    assert ferm.loss.contrastive.weight.shape == (8, 8)
    assert isinstance(ferm.target_updater, SoftUpdateByNetwork)
    assert ferm.target_updater.tau == 0.1
    assert ferm.target_updater.taus == {"encoder_network_params": 0.2}
    both = build("rad", "cnn", rotation={"name": "sampled"})
    assert [type(each) for each in both.replay.transform] == [SO2Augmentation, RandomViews]


def test_contrastive_pretraining_trains_the_encoder_only():
    ferm = build("ferm", "ferm", first=61, optimizer={"learning_rate": 3e-4})
    ferm.extend(transitions(ferm))
    before = parameters(ferm)
    scalars = ferm.update()
    assert list(scalars.keys()) == ["loss_contrastive"]
    assert ferm.updates == 1
    after = parameters(ferm)
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    # the policy shares the encoder's convolutions, which have the encoder's names
    encoder = {name for name in after if name.startswith("encoder_network")}
    assert any(".trunk." in name for name in encoder)
    assert changed == encoder | {"contrastive.weight"}
    losses = [float(ferm.update()["loss_contrastive"]) for _ in range(60)]
    assert sum(losses[-10:]) < sum(losses[:10])


def test_contrastive_pretraining_and_behaviour_cloning_go_together():
    ferm = build("ferm", "ferm", first=60, init={"name": "bc"})
    demonstrations = transitions(ferm)
    demonstrations[keys.IS_DEMONSTRATION] = torch.ones_like(demonstrations[keys.IS_DEMONSTRATION])
    ferm.extend(demonstrations)
    before = parameters(ferm)
    scalars = [ferm.update() for _ in range(60)]
    assert set(scalars[0].keys()) == {"loss_contrastive", "loss_bc", "entropy"}
    after = parameters(ferm)
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    assert changed
    assert not any(name.startswith("qvalue_network") for name in changed)
    assert {name.split("_params")[0] for name in changed} >= {"actor_network", "encoder_network"}
    for loss in ("loss_contrastive", "loss_bc"):
        values = [float(each[loss]) for each in scalars]
        assert sum(values[-10:]) < sum(values[:10])


def test_a_contrastive_loss_on_an_encoder_that_the_policy_does_not_share_gives_a_warning(caplog):
    build("ferm", "cnn")
    assert "contrastive has no effect on the encoder of the policy of 'cnn'" in caplog.text


@pytest.mark.parametrize("preset", ["bc", "dagger", "flow"])
def test_imitation_trains_the_convolutions_of_ferm(preset):
    imitator = build(preset, "ferm")
    imitator.extend(transitions(imitator))
    imitator.update()
    trunk = [p for name, p in imitator.loss.named_parameters() if ".trunk." in name]
    assert trunk
    assert all(float(p.grad.abs().max()) > 0 for p in trunk)


@pytest.mark.parametrize(("first", "share"), [(4, 0.0), (0, 4 / 10)])
def test_importance_weights_start_with_the_losses_of_the_algorithm(first, share, monkeypatch):
    ferm = build("ferm_per", "ferm", first)
    ferm.extend(transitions(ferm))
    seen, sampler = [], ferm.replay.sampler
    monkeypatch.setattr(sampler, "anneal", seen.append)
    for _ in range(4):
        ferm.update()
    ferm.update()
    assert seen[-1] == pytest.approx(share)
    ferm.updates = 9
    ferm.sample()
    assert seen[-1] == pytest.approx(5 / 6 if first else 9 / 10)


def test_the_policy_of_ferm_acts_on_the_convolutions_of_the_encoder_without_training_them():
    ferm = build("ferm", "ferm")
    ferm.extend(transitions(ferm))
    for _ in range(2):
        ferm.update()
    loss = ferm.loss
    actor = loss.actor_network_params["module", "0", "module", "trunk"]
    encoder = loss.encoder_network_params["module", "trunk"]
    for _ in range(2):
        for key, value in encoder.items(True, True):
            assert value.data_ptr() == actor[key].data_ptr()
        ferm.load_state_dict(build("ferm", "ferm").state_dict())  # keeps the memory
    acting = ferm.policy.policy.get_submodule("module.0.module").trunk
    assert {p.data_ptr() for p in acting.parameters()} == {
        p.data_ptr() for p in encoder.values(True, True)
    }
    assert len({id(p) for p in loss.parameters()}) == len(list(loss.parameters()))
    loss.zero_grad()
    batch = ferm.sample()
    loss(batch)["loss_actor"].backward()
    assert all(value.grad is None for value in encoder.values(True, True))


@pytest.mark.parametrize(
    "change",
    [
        copy.deepcopy,
        lambda loss: pickle.loads(pickle.dumps(loss)),
        lambda loss: loss.double(),
        lambda loss: copy.deepcopy(loss).double().float().share_memory(),
    ],
    ids=["deepcopy", "pickle", "double", "several"],
)
def test_copies_and_conversions_of_the_loss_share_the_encoder_too(change):
    loss = change(build("ferm", "ferm").loss)
    actor = loss.actor_network_params["module", "0", "module", "trunk"]
    encoder = loss.encoder_network_params["module", "trunk"]
    for key, value in encoder.items(True, True):
        assert value.data_ptr() == actor[key].data_ptr()
        assert value.dtype == actor[key].dtype
        assert not actor[key].requires_grad
    assert loss.state_dict().keys() == build("ferm", "ferm").loss.state_dict().keys()


@pytest.mark.parametrize(
    ("preset", "network"),
    [
        *(("sac", "cnn"), ("sacfd", "equi"), ("drq", "cnn"), ("ferm", "ferm"), ("rlpd", "cnn")),
        *(("bc", "cnn"), ("bc", "asr"), ("sdqfd", "equi_asr")),
        ("flow", "cnn"),
    ],
)
def test_the_loss_takes_tensors_by_name(preset, network):
    learner = build(preset, network)
    loss, found = learner.loss, []
    data = learner.replay.transform(transitions(learner)).select(*loss.in_keys)
    named = {"_".join([key] if isinstance(key, str) else key): data[key] for key in loss.in_keys}
    for call in (lambda: loss(data), lambda: loss(**named)):
        torch.manual_seed(0)
        if preset == "rlpd":
            loss.generator.manual_seed(0)
        found.append(call())
    values = found[1] if len(loss.out_keys) > 1 else [found[1]]
    for name, value in zip(loss.out_keys, values, strict=True):
        torch.testing.assert_close(value, found[0][name])


def test_the_acting_policy_sees_the_centre_of_larger_images():
    ferm = build("ferm", "ferm")
    state = transitions(ferm).select(*ferm.observation_keys)
    other = state.clone()
    border = torch.ones(IMAGE, IMAGE, dtype=torch.bool)
    border[3 : 3 + CROP, 3 : 3 + CROP] = False
    other[keys.DEPTH][..., border] = 0.1
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        first, second = ferm.policy(state)[keys.ACTION], ferm.policy(other)[keys.ACTION]
        other[keys.DEPTH][..., ~border] = 0.1
        assert torch.equal(first, second)
        assert not torch.equal(first, ferm.policy(other)[keys.ACTION])


def test_rotated_copies_are_stored_or_transitions_rotated_when_sampled():
    stored = build("sacfd_so2", "cnn", rotation={"name": "stored"})
    assert isinstance(stored, SAC)
    data = transitions(stored)
    stored.extend(data)
    assert len(stored.replay) == 5 * len(data)
    assert [type(each) for each in stored.replay.transform] == [StoredCopies]
    sampled = build("sacfd_so2", "cnn")
    sampled.extend(data)
    assert len(sampled.replay) == len(data)
    assert [type(each) for each in sampled.replay.transform] == [SO2Augmentation]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contrastive": {"name": "info_nce"}}, "compares views: set views.name"),
        ({"views": {"pixels": 2}}, r"'views.pixels'. Known: name \(views.name=shift has it\)"),
        ({"views": {"name": "shft"}}, "unknown views.name 'shft'. Did you mean 'shift'"),
        (
            {"views": {"name": "crop", "pixels": 2}},
            r"'views.pixels'. Known: name, size, target_views, views \(views.name=shift has it\)",
        ),
        ({"views": {"name": "shift", "pixels": 0}}, "  views.pixels: must be"),
    ],
)
def test_options_that_do_not_go_together_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        build("sacfd", "cnn", **changes)


def test_a_crop_larger_than_the_image_is_refused():
    problem = build("sac", "cnn").problem
    settings = parse(ALGORITHMS["sac"], {"views": {"name": "crop", "size": 128}}, "sac")
    with pytest.raises(ConfigError, match=r"views.size=128: .* only 64 px"):
        settings.build(parse(NETWORKS["cnn"], {}, "cnn"), problem)
