"""Optimisers of single terms of a loss, against a loop with torch."""

import math
import warnings
from types import SimpleNamespace

import pytest
import torch
from torchrl.trainers import (
    DefaultOptimizationStepper,
    MixedPrecisionOptimizationStepper,
    Trainer,
)

from ba_torchrl.algorithms.optimizers import Optimizers
from tests.algorithms.tiny import FERM, build, transitions

RATE, WEIGHT, TAU, ENCODER_TAU = 3e-3, 0.5, 0.2, 0.4
SETTINGS = {
    **FERM,
    "contrastive": {"name": "info_nce", "weight": WEIGHT, "updates": 3},
    "tau": TAU,
    "encoder_tau": ENCODER_TAU,
}


def ferm(**optimizer):
    learner = build("sac", "ferm", **SETTINGS, optimizer={"learning_rate": RATE, **optimizer})
    learner.extend(transitions(learner))
    return learner


def update_by_hand(loss, batch, optimizers, clamp, *, pretrains):
    """CURL's update: a step on the critics' and the policy's loss, two on the contrastive one."""

    def step(total, *chosen):
        for optimizer in chosen:
            optimizer.zero_grad()
        total.backward()
        for name, parameter in loss.named_parameters():
            if name != "log_alpha" and parameter.grad is not None:
                parameter.grad = parameter.grad.clamp(-clamp, clamp)
        for optimizer in chosen:
            optimizer.step()

    critic, encoder, contrastive = optimizers
    if not pretrains:
        losses = loss(batch)
        step(losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"], critic)
    step(loss.contrastive_loss(batch)["loss_contrastive"], encoder, contrastive)
    with torch.no_grad():
        for name, tau in (("encoder", ENCODER_TAU), ("qvalue", TAU)):
            target = getattr(loss, f"target_{name}_network_params")
            for key, value in getattr(loss, f"{name}_network_params").items(True, True):
                target[key].lerp_(value, tau)  # rounds as SoftUpdate does


@pytest.mark.parametrize("clamp", [None, 0.02])
def test_ferm_takes_the_steps_of_three_optimisers(clamp):
    learner, other = (ferm(gradient_clamp=clamp) for _ in range(2))
    loss = other.loss
    named = dict(loss.named_parameters())
    similarity = named.pop("contrastive.weight")
    encoder = [p for name, p in named.items() if name.startswith("encoder_network_params")]
    optimizers = [
        torch.optim.Adam(each, rate, fused=True)
        for each, rate in (
            (named.values(), RATE),
            (encoder, WEIGHT * RATE),
            ([*encoder, similarity], WEIGHT * RATE),
        )
    ]
    for number in range(6):
        is_first = number < 3
        torch.manual_seed(number)
        scalars = learner.update()
        assert ("loss_qvalue" in scalars) is not is_first
        torch.manual_seed(number)
        bound = math.inf if clamp is None else clamp
        update_by_hand(loss, other.sample(), optimizers, bound, pretrains=is_first)
        for name, value in loss.state_dict().items():
            # Adam's first steps magnify rounding errors of small gradients
            difference = float((learner.loss.state_dict()[name] - value).abs().max())
            assert difference <= RATE / 100, (number, name)


def test_every_learning_rate_follows_the_schedule_of_the_run():
    learner = ferm(learning_rate_end_factor=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number, expected in enumerate(torch.linspace(RATE, RATE / 10, 11).tolist()):
            states = learner.stepper.state_dict()
            names = [name for name in states if name.endswith("optimizer")]
            assert len(names) == 3
            for name in names:
                rates = [group["lr"] for group in states[name]["param_groups"]]
                factor = 1 if name == "optimizer" else WEIGHT
                assert rates == pytest.approx([factor * expected] * len(rates))
            if number < 10:
                learner.update()


def test_weight_decay_of_all_optimisers_is_that_of_the_networks():
    states = ferm(weight_decay=0.1).stepper.state_dict()
    decay = {
        name: [group["weight_decay"] for group in state["param_groups"]]
        for name, state in states.items()
        if name.endswith("optimizer")
    }
    assert decay == {
        "optimizer": [0.1, 0.0],
        "encoder_optimizer": [0.1],
        "contrastive_optimizer": [0.1],
    }


def test_terms_with_different_optimisers_are_not_minimised_together():
    parameters = torch.nn.Linear(2, 2).parameters
    main, first, second, third = (torch.optim.SGD(parameters(), 0.1) for _ in range(4))
    of_terms = {"loss_a": {"a": first, "b": second}, "loss_c": {"c": third}}
    optimizers = Optimizers(main, of_terms, lambda each: torch.optim.lr_scheduler.LinearLR(each))
    assert optimizers.of(["loss_x", "loss_y"]) == [main]
    assert optimizers.of(["loss_a"]) == [first, second]
    for terms in (["loss_x", "loss_a"], ["loss_a", "loss_c"]):
        with pytest.raises(ValueError, match=f"{terms[0]}, {terms[1]} have different optimisers"):
            optimizers.of(terms)
    with pytest.raises(ValueError, match="two optimisers have the name 'a'"):
        Optimizers(
            main,
            {"loss_a": {"a": first}, "loss_b": {"a": second}},
            torch.optim.lr_scheduler.LinearLR,
        )


def test_only_gradients_of_the_step_are_clamped():
    first, second = (torch.nn.Parameter(torch.zeros(1)) for _ in range(2))
    main, own = (torch.optim.SGD([p], 1.0) for p in (first, second))
    optimizers = Optimizers(
        main,
        {"loss_own": {"own": own}},
        torch.optim.lr_scheduler.LinearLR,
        clamp=0.5,
        clamped=[first, second],
    )
    first.grad = torch.full((1,), 3.0)
    optimizers.minimize((2 * second).sum(), ["loss_own"])
    assert (float(first.grad), float(second.grad)) == (3.0, 0.5)


def updated(learner, optimize, updates=3):
    """The parameters after some updates by a function of a batch."""
    for number in range(updates):
        torch.manual_seed(number)
        optimize(learner.sample())
    return list(learner.loss.state_dict().values())


def learners(network="cnn", **settings):
    """Two equal learners, and the parameters of a third after its own updates."""
    made = [build("sac", network, **settings) for _ in range(3)]
    for learner in made:
        learner.extend(transitions(learner))
    return *made[:2], updated(made[2], lambda batch: made[2].minimize(batch, made[2].stages))


@pytest.mark.parametrize(
    "make",
    [
        lambda learner: DefaultOptimizationStepper(),
        lambda learner: MixedPrecisionOptimizationStepper(learner.optimizer, clip_norm=None),
    ],
    ids=["default", "mixed precision"],
)
def test_a_learner_takes_a_stepper_of_torchrl(make):
    learner, other, expected = learners(replay={"name": "prioritized"})
    learner.stepper = make(learner)
    found = updated(learner, lambda batch: learner.minimize(batch, learner.stages))
    assert all(torch.equal(one, two) for one, two in zip(found, expected, strict=True))
    other.stepper = make(other)
    other.load_state_dict(learner.state_dict())
    state, restored = (each.optimizer.state_dict()["state"] for each in (learner, other))
    assert torch.equal(state[0]["exp_avg"], restored[0]["exp_avg"])
    learner.sample = lambda: batch
    batch = other.sample()
    batch["next", "reward"] += torch.nan
    with pytest.raises(FloatingPointError, match="not finite at update 3"):
        learner.update()


def test_a_trainer_of_torchrl_takes_the_optimisers():
    settings = {"learning_rate_end_factor": 0.1, "gradient_clamp": 0.01, "weight_decay": 0.1}
    learner, _, expected = learners(optimizer=settings)
    trainer = Trainer(
        collector=SimpleNamespace(state_dict=dict),
        total_frames=1,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=learner.loss,
        optimization_stepper=learner.stepper,
        progress_bar=False,
    )
    trainer.register_op("post_optim", learner.target_updater.step)
    found = updated(learner, trainer.optim_steps)
    assert all(torch.equal(one, two) for one, two in zip(found, expected, strict=True))
    rate = trainer.state_dict()["optimization_stepper"]["optimizer"]["param_groups"][0]["lr"]
    assert rate < learner.config.optimizer.learning_rate
