"""The runs of a grid."""

import pytest

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.graded import GradedSets
from tests.training.grid.grids import COMMON, PICK, PLACE, PRESETS, REACH, planned


def test_a_grid_is_the_product_of_its_axes_ordered_by_seed(tmp_path):
    runs = planned(
        tmp_path, tasks=[REACH, PICK], algorithms=["sac", "sacfd"], networks=["cnn", "small"]
    )
    assert len(runs) == len({run.run_dir for run in runs}) == 16
    assert [run.seed for run in runs] == [0] * 8 + [1] * 8
    assert {run.task for run in runs[:8]} == {REACH, PICK}
    assert {run.label for run in runs[:8]} == {"sac cnn", "sac small", "sacfd cnn", "sacfd small"}
    first = runs[0]
    assert (first.task, first.label, first.seed) == (REACH, "sac cnn", 0)
    assert (first.benchmark, first.resume, first.total_updates) == ("little", True, 6)
    assert first.algorithm.replay.name == "uniform"
    assert first.algorithm.batch_size == 8
    assert first.run_dir.endswith("grid/close_loop_block_reaching/sac_cnn/seed0")
    assert [run.seed for run in planned(tmp_path, seeds=[7, 3])] == [7, 3]


def test_the_more_specific_override_wins(tmp_path):
    runs = planned(
        tmp_path,
        tasks=[REACH, PICK],
        algorithms=["sac", "sacfd"],
        networks=["cnn", "small"],
        seeds=1,
        per_task={PICK: {"demonstrations": 3, "env": {"max_steps": 9}, "min_replay": 11}},
        per_algorithm={"sacfd": {"algorithm": {"gamma": 0.9}, "demonstrations": 4}},
        per_network={"small": {"network": {"width": 0.5}, "demonstrations": 5}},
        common={"network": {"depth_scale_m": 0.1}},
    )
    by = {(run.task, run.label): run for run in runs}
    demonstrations = {key: run.demonstrations for key, run in by.items()}
    assert demonstrations[REACH, "sac cnn"] == 2
    assert demonstrations[PICK, "sac cnn"] == 3
    assert demonstrations[PICK, "sacfd cnn"] == 4
    assert demonstrations[PICK, "sacfd small"] == 5
    pick = by[PICK, "sacfd small"]
    assert pick.env.given == {"obs_size": 64, "max_steps": 9}
    assert by[REACH, "sacfd small"].env.given == {"obs_size": 64, "max_steps": 8}
    assert (pick.algorithm.gamma, pick.algorithm.batch_size) == (0.9, 8)
    assert by[PICK, "sac small"].algorithm.gamma == 0.99
    assert (pick.network.width, pick.network.depth_scale_m) == (0.5, 0.1)
    assert by[PICK, "sac cnn"].network.width == 1.0
    assert PRESETS["network", "small"] == {"name": "cnn", "width": 0.25}


def test_another_part_of_one_task_drops_the_fields_that_only_the_preset_had(tmp_path):
    own = {"algorithm": {"replay": {"name": "uniform"}}}
    runs = planned(
        tmp_path, seeds=1, tasks=[REACH, PICK], algorithms=["per"], per_task={REACH: own}
    )
    replays = {run.task: run.algorithm.replay for run in runs}
    assert replays[PICK].expert_bonus == 2.0
    assert replays[REACH].name == "uniform"
    own["algorithm"]["replay"]["expert_bonus"] = 2.0  # the user's own are refused
    with pytest.raises(ConfigError, match=r"unknown parameter 'replay\.expert_bonus'"):
        planned(tmp_path, seeds=1, algorithms=["per"], per_task={REACH: own})


def test_skip_leaves_out_matching_runs(tmp_path):
    runs = planned(
        tmp_path,
        tasks=[REACH, PICK],
        algorithms=["sac", "sacfd"],
        networks=["cnn", "small"],
        seeds=1,
        skip=[{"algorithm": "sac", "network": ["cnn"]}, {"task": PICK, "algorithm": "sacfd"}],
    )
    assert {(run.task, run.label) for run in runs} == {
        (REACH, "sac small"),
        (REACH, "sacfd cnn"),
        (REACH, "sacfd small"),
        (PICK, "sac small"),
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": [REACH, "close_loop/flying"]}, "unknown task 'close_loop/flying'"),
        ({"algorithms": ["sac", "ppo"]}, "unknown algorithm 'ppo'.*sacfd"),
        ({"networks": ["mlp"]}, "unknown network 'mlp'.*small"),
        ({"per_task": {"close_loop/flying": {}}}, "unknown task 'close_loop/flying'"),
        ({"per_network": {"smal": {}}}, "unknown network 'smal'"),
        ({"skip": [{"algorithm": ["sac", "ddpg"]}]}, "unknown algorithm 'ddpg'"),
        ({"skip": [{"robot": "kuka"}]}, "unknown axis 'robot'.*task, algorithm, network"),
        ({"skip": [{"task": REACH}]}, "grid is empty"),
        ({"tasks": []}, "tasks"),
        ({"seeds": 0}, "seeds"),
        ({"seeds": 10**11}, "seeds"),
        ({"seeds": [1, 1]}, "names one twice"),
        ({"seeds": [2**52]}, "seeds.*must be at most 4503599627370495"),
        ({"networks": ["cnn", "cnn"]}, "names one twice"),
        ({"sedes": 3}, "Did you mean 'seeds'"),
        ({"common": {"total_update": 5}}, "Did you mean 'total_updates'"),
        ({"common": {"seed": 5}}, "seed: set by the benchmark"),
        ({"common": {"network": {"name": "equi"}}}, "network.name=equi.*write networks=.equi."),
        (
            {"per_task": {REACH: {"algorithm": {"name": "rlpd"}}}},
            "algorithm.name=rlpd.*write algorithms=.rlpd.",
        ),
        ({"common": {"network": {"widht": 1.0}}}, "with sac small: .*Did you mean 'width'"),
        ({"common": {"env": {"in_hand_size": 30}}}, f"{REACH}.*: 'in_hand_size' is for open-loop"),
        ({"common": {"env": {"robot": "sawyer"}}}, "kuka"),
        ({"tasks": [PLACE]}, "algorithm 'sac' learns close_loop tasks"),
        ({"per_task": {REACH: {"env": {"obs_sise": 64}}}}, "Did you mean 'obs_size'"),
        (
            {"variants": ["a b", "a_b"], "per_variant": {"a b": {}, "a_b": {}}},
            "sac small a b and .*sac small a_b have the same run folder",
        ),
    ],
)
def test_wrong_grids_are_refused(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        planned(tmp_path, **changes)
    assert not (tmp_path / "grid").exists()


def test_variants_are_an_axis_of_settings(tmp_path):
    sets = tmp_path / "sets"
    GradedSets(sets / REACH, REACH, 2, COMMON["env"], parallel=False).make("random")
    path = "demonstrations_path"
    settings = {grade: {path: f"{sets}/{{task}}/{grade}"} for grade in ("random", "expert")}
    options = {"variants": ["", "random"], "per_variant": settings, "seeds": 1}
    rule = {"network": "cnn", "variant": "random"}
    runs = planned(tmp_path, skip=[rule], networks=["cnn", "small"], **options)
    assert [run.label for run in runs] == ["sac cnn", "sac small", "sac small random"]
    assert runs[1].demonstrations_path is None
    assert runs[2].demonstrations_path == str(sets / REACH / "random")
    assert runs[2].run_dir.endswith("close_loop_block_reaching/sac_small_random/seed0")
    for names, message in (
        (["expert"], r"no demonstrations at .*block_reaching/expert"),
        (["rando"], "unknown variant 'rando'. Did you mean 'random'"),
        (["random", "random"], "names one twice"),
    ):
        with pytest.raises(ConfigError, match=message):
            planned(tmp_path, **{**options, "variants": names})
