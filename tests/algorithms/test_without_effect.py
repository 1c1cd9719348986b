"""Values that have no effect together with others give a warning at the start of a run."""

import logging

import pytest

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.core.config import parse
from tests.algorithms.tiny import make_experiment

COPIES = {"augmentation": "so2", "stored_copies": 2}


def messages(name, network, values):
    config = parse(ALGORITHMS[name], values, name)
    return list(config.without_effect(parse(NETWORKS[network], {}, network)))


@pytest.mark.parametrize(
    ("name", "network", "values", "expected"),
    [
        ("sac", "cnn", {"expert_bonus": 2.0}, "expert_bonus has no effect without replay="),
        ("sac", "cnn", {"importance_weighted": "none"}, "importance_weighted has no effect"),
        (
            "sac",
            "cnn",
            {
                "replay": "prioritized",
                "importance_weighted": "none",
                "importance_norm": "mean",
            },
            "importance_norm has no effect with importance_weighted='none'",
        ),
        ("rlpd", "cnn", {"importance_norm": "mean"}, "importance_norm has no effect"),
        ("iql", "cnn", {"priority_exponent": 0.5}, "priority_exponent has no effect"),
        ("bc", "cnn", {"importance_exponent": 0.0}, "importance_exponent has no effect"),
        ("spatial_q", "asr", {"expert_bonus": 0.0}, "expert_bonus has no effect"),
        (
            "spatial_q",
            "asr",
            {"demonstrations": "none", "demonstration_weight": 1.0},
            "demonstration_weight has no effect with demonstrations='none'",
        ),
        ("spatial_q", "asr", {"demonstrations": "adet", "margin": 0.2}, "margin has no effect"),
        ("spatial_q", "asr", {"first_beta": 10.0}, "with demonstrations='sdqfd'"),
        ("spatial_q", "asr", {"augmentation_probability": 0.5}, "without augmentation"),
        (
            "spatial_q",
            "asr",
            {"augmentation": "se2", "augmentation_order": 8},
            "augmentation_order has no effect without augmentation='cn'",
        ),
        ("sac", "cnn", {"augmentation_probability": 0.5}, "without augmentation='so2'"),
        ("sac", "cnn", {**COPIES, "augmentation_probability": 0.5}, "of sampled transitions"),
        ("rlpd", "cnn", {"augmentation_probability": 0.5}, "without augmentation"),
        ("sac", "cnn", {"crop_size": 64}, "crop_size has no effect without view_transform='crop'"),
        (
            "sac",
            "cnn",
            {"view_transform": "crop", "shift_pixels": 2},
            "shift_pixels has no effect without view_transform='shift'",
        ),
        (
            "sac",
            "cnn",
            {"demonstration_weight": 0.0, "demonstration_distance": "kl"},
            "demonstration_distance has no effect with demonstration_weight=0",
        ),
        (
            "sac",
            "cnn",
            {"demonstration_weight": 0.0, "imitate_successes": True},
            "imitate_successes has no effect with demonstration_weight=0 and uniform replay",
        ),
        (
            "sac",
            "equi",
            {"view_transform": "crop", "contrastive_weight": 1.0},
            "contrastive_weight has no effect on the encoder of the policy of 'equi'",
        ),
    ],
)
def test_values_without_effect(name, network, values, expected):
    (message,) = messages(name, network, values)
    assert expected in message


@pytest.mark.parametrize(
    ("network", "values"),
    [
        ("cnn", {"replay": "prioritized", "expert_bonus": 0.0, "importance_weighted": "none"}),
        ("cnn", {"augmentation": "so2", "augmentation_probability": 0.5}),
        ("cnn", {"view_transform": "crop", "crop_size": 64}),
        ("cnn", {"demonstration_weight": 0.0, "imitate_successes": True, "replay": "symmetric"}),
        ("ferm", {"view_transform": "crop", "contrastive_weight": 1.0}),
    ],
)
def test_values_with_an_effect(network, values):
    assert messages("sac", network, values) == []


def test_a_run_starts_with_the_warnings(tmp_path, caplog):
    algorithm = {"name": "sac", "expert_bonus": 2.0}
    settings = {"demonstrations": 0, "demonstrations_noise": 0.2}
    made = make_experiment(tmp_path, "cnn", algorithm, **settings)
    with caplog.at_level(logging.WARNING):
        made.run()
    assert "algorithm.expert_bonus has no effect without replay='prioritized'" in caplog.text
    assert "demonstrations_noise has no effect with demonstrations=0" in caplog.text


def test_a_run_of_behaviour_cloning_only_compiles_nothing(tmp_path):
    settings = {"compile_mode": "default", "pretrain_updates": 2, "demonstrations": 2}
    made = make_experiment(tmp_path, "cnn", {"name": "sac", "init": "bc"}, **settings)
    (message,) = made.config.without_effect()
    assert message == "compile_mode has no effect without updates after those of init: 'bc'"
    made = make_experiment(
        tmp_path / "more", "cnn", {"name": "sac", "init": "bc"}, **settings, total_updates=3
    )
    assert list(made.config.without_effect()) == []
