"""Demonstrations in other libraries' formats; most episodes are made by hand."""

import json
import pickle
import re
import shutil
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import h5py
import numpy as np
import pytest
import torch
import zarr
from tensordict import NonTensorStack, TensorDict

import ba_torchrl
from ba_torchrl.core.errors import (
    ConfigError,
    DamagedFilesError,
    MissingPackageError,
    UnknownNameError,
)
from ba_torchrl.demonstrations import (
    export_demonstrations,
    load_demonstrations,
    save_demonstrations,
)
from ba_torchrl.demonstrations.demo_files import check_demonstrations, read_demonstrations
from ba_torchrl.demonstrations.formats import base
from ba_torchrl.demonstrations.formats.base import FORMATS, Format, read_card
from ba_torchrl.demonstrations.formats.hdf5 import _split
from ba_torchrl.demonstrations.mapping import with_results
from ba_torchrl.demonstrations.plausibility import contradictions
from ba_torchrl.envs.settings import resolve_env
from tests.envs.test_lerobot import check_features
from tests.tasks.episodes import demonstrations
from tests.training.test_limits import limited

TASK, ENV, SIZE = "close_loop/block_picking", {"obs_size": 64}, 64
PATHS = {
    "minari": "picking-v0",
    "hdf5": "picking.hdf5",
    "zarr": "picking.zarr",
    "lerobot": "picking",
}
SHAPES = {
    "depth": ((1, SIZE, SIZE), torch.float32),
    "in_hand": ((3, 24, 24), torch.float32),
    "wrist_rgb": ((3, 48, 48), torch.uint8),
    "segmentation": ((1, SIZE, SIZE), torch.int32),
    "point_cloud": ((16, 3), torch.float32),
    "proprio": ((8,), torch.float32),
    "holding": ((1,), torch.bool),
}


def values(shape, dtype, generator):
    numbers = torch.rand(shape, generator=generator)
    if dtype == torch.bool:
        return numbers > 0.5
    return numbers if dtype.is_floating_point else (200 * numbers).to(dtype)


def episode(steps, seed, success=True):
    """Return an episode [steps] with all kinds of entries."""
    generator = torch.Generator().manual_seed(seed)
    now, following = {}, {}
    for key, (shape, dtype) in SHAPES.items():
        rows = values((steps + 1, *shape), dtype, generator)
        now[key], following[key] = rows[:-1], rows[1:]
    for key in ("action", "expert_action"):
        now[key] = values((steps, 5), torch.float32, generator)
    now["is_expert"] = values((steps, 1), torch.bool, generator)
    is_last = torch.arange(steps)[:, None] == steps - 1
    following["success"] = following["terminated"] = is_last & success
    following["truncated"] = is_last & (not success)
    following["done"], following["fault"] = is_last, torch.zeros_like(is_last)
    following["reward"] = following["success"].float()
    following["step_count"] = torch.arange(1, steps + 1)[:, None]
    for key in ("success", "terminated", "truncated", "done", "fault", "step_count"):
        now[key] = torch.cat([torch.zeros_like(following[key][:1]), following[key][:-1]])
    text = [f"pick up block {seed}"] * steps
    now["instruction"], following["instruction"] = NonTensorStack(*text), NonTensorStack(*text)
    return TensorDict({**now, "next": TensorDict(following, [steps])}, [steps]).clone()


@pytest.fixture
def episodes():
    return [episode(3, 0), episode(2, 1, success=False), episode(4, 2)]


@pytest.fixture(scope="module")
def collected():
    return demonstrations(TASK, 2, env=ENV, noise=0.2)


def exported(path, episodes, name, **changes):
    options = {"format": name, "task": TASK, "env": ENV, "seed": 7, **changes}
    export_demonstrations(path / PATHS[name], episodes, **options)
    return path / PATHS[name]


def assert_equal(found, wanted):
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        for key in other.keys(True, True):
            ours, theirs = one.get(key), other.get(key)
            if isinstance(theirs, torch.Tensor):
                assert ours.dtype == theirs.dtype, key
                assert torch.equal(ours, theirs), key
            else:
                assert ours.tolist() == theirs.tolist(), key


@pytest.mark.parametrize("name", ["hdf5", "zarr", "lerobot"])
def test_every_value_comes_back(name, episodes, tmp_path):
    if name == "lerobot":
        pytest.importorskip("lerobot")
    path = exported(tmp_path, episodes, name, policy="a hand")
    assert_equal(load_demonstrations(path, task=TASK, env=ENV), episodes)
    card = read_card(path)
    assert (card.policy, card.mean_return) == ("a hand", card.success_rate)
    assert (card.task, card.robot, card.seed, card.source) == (TASK, "kuka", 7, "expert")
    assert (card.episodes, card.steps, card.success_rate) == (3, 9, pytest.approx(2 / 3))
    assert card.instructions == [f"pick up block {i}" for i in range(3)]
    page = path / "README.md" if path.is_dir() else path.with_name("picking.hdf5.card.md")
    image = [1, SIZE, SIZE] if name == "lerobot" else [SIZE, SIZE, 1]
    row = f"| `{card.entries['depth'].name}` | observation `depth` | float32 | {image} |"
    assert row in page.read_text()
    assert card.entries["depth"].shape == (1, SIZE, SIZE)


@pytest.mark.parametrize("name", ["minari", "hdf5", "zarr", "lerobot"])
def test_episodes_of_an_environment_come_back(name, collected, tmp_path):
    if name == "lerobot":
        pytest.importorskip("lerobot")
    path = exported(tmp_path, collected, name)
    check_demonstrations(path, task=TASK, env=ENV, least=2)
    assert_equal(load_demonstrations(path, task=TASK, env=ENV), collected)
    with pytest.raises(ConfigError, match="obs_size: collected with 64, needed 128"):
        load_demonstrations(path, task=TASK, env={})
    with pytest.raises(ConfigError, match="holds 2 episodes, 3 are needed"):
        check_demonstrations(path, task=TASK, env=ENV, least=3)
    with pytest.raises(ConfigError, match="exists already"):
        exported(tmp_path, collected, name)


@pytest.mark.parametrize("name", ["minari", "hdf5", "zarr", "lerobot"])
def test_an_export_that_fails_in_the_middle_leaves_nothing(name, collected, tmp_path, monkeypatch):
    if name == "lerobot":
        pytest.importorskip("lerobot")
    write = type(FORMATS[name]).write

    def write_one_and_stop(self, path, episodes, card):
        write(self, path, episodes[:1], card)
        raise KeyboardInterrupt

    def stop(*_):
        raise KeyboardInterrupt

    for what in ((type(FORMATS[name]), "write", write_one_and_stop), (base, "card_file", stop)):
        with monkeypatch.context() as patch:
            patch.setattr(*what)
            with pytest.raises(KeyboardInterrupt):
                exported(tmp_path, collected, name)
        assert list(tmp_path.iterdir()) == []
    killed = tmp_path / f".{PATHS[name]}.scratch" / PATHS[name]  # left by a process that was killed
    (killed / "data").mkdir(parents=True)
    path = exported(tmp_path, collected, name)
    assert_equal(load_demonstrations(path, task=TASK, env=ENV), collected)
    assert not killed.parent.exists()


def test_a_full_disk_is_an_error_of_the_system(collected, tmp_path, monkeypatch):
    """HDF5 itself would end the process."""
    with limited("RLIMIT_FSIZE", 100_000), pytest.raises(OSError, match="File too large"):
        exported(tmp_path, [episode.repeat(9) for episode in collected], "hdf5")
    full = SimpleNamespace(free=100_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
    with pytest.raises(OSError, match=r"No space left on device: .* needed, 0.1 MB are free"):
        exported(tmp_path, collected, "minari")
    assert list(tmp_path.iterdir()) == []


def test_minari_recovers_the_environment(collected, tmp_path, monkeypatch):
    import minari

    exported(tmp_path, collected, "minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset(PATHS["minari"])
    env = dataset.recover_environment(eval_env=True)
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    assert all(
        values.dtype == dataset.observation_space[key].dtype
        for key, values in dataset[0].observations.items()
    )
    assert minari.get_normalized_score(dataset, dataset[0].rewards.sum()) == 1
    assert env.spec.id == "BulletArm/CloseLoopBlockPicking-v0"
    env.reset(seed=0)
    first = next(iter(dataset.iterate_episodes()))
    for action, depth in zip(first.actions, first.observations["depth"][1:], strict=True):
        np.testing.assert_array_equal(env.step(action)[0]["depth"], depth)
    env.close()


def test_minari_lists_its_data_sets_unless_other_exports_are_beside_them(
    collected, tmp_path, monkeypatch, caplog
):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    exported(tmp_path, collected, "minari")
    exported(tmp_path, collected, "hdf5")
    assert list(minari.list_local_datasets()) == [PATHS["minari"]]
    assert not caplog.records
    exported(tmp_path, collected, "zarr")
    with pytest.raises(ValueError, match=r"Malformed dataset ID: picking\.zarr"):
        minari.list_local_datasets()
    assert "takes picking.zarr for a data set: export Minari's data sets to" in caplog.text


def test_minari_needs_an_id_and_observations_of_the_environment(collected, tmp_path, episodes):
    options = {"format": "minari", "task": TASK, "env": ENV, "seed": 0}
    for name in ("pick ing", "picking", "picking-v"):
        with pytest.raises(ConfigError, match=f"{name} is no id of a data set"):
            export_demonstrations(tmp_path / name, collected, **options)
    with pytest.raises(ConfigError, match=r"does not observe .*wrist_rgb"):
        export_demonstrations(tmp_path / "a-v0", episodes, **options)


@pytest.mark.filterwarnings("ignore::UserWarning")  # of what a card of Minari lacks
@pytest.mark.parametrize("rows", [3, 4])  # without and with those of the reset
def test_nested_observations_and_infos_of_minari_are_mapped(rows, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    spaces = gymnasium.spaces
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    depth = np.random.default_rng(0).uniform(0.1, 0.2, (4, SIZE, SIZE)).astype(np.float32)
    buffer = minari.data_collector.EpisodeBuffer(
        id=0,
        observations={"arm": {"depth": depth, "grip": np.linspace(0, 1, 4)[:, None]}},
        actions=np.full((3, 5), np.linspace(-1, 1, 3)[:, None]),
        rewards=np.zeros(3),
        terminations=np.array([False, False, True]),
        truncations=np.zeros(3, dtype=bool),
        infos={"won": {"all": np.array([0, 0, 0, 1])[4 - rows :]}},
    )
    arm = {"depth": spaces.Box(0, 1, depth.shape[1:]), "grip": spaces.Box(0, 1, (1,), np.float64)}
    minari.create_dataset_from_buffers(
        "theirs-v0",
        [buffer],
        observation_space=spaces.Dict({"arm": spaces.Dict(arm)}),
        action_space=spaces.Box(-1, 1, (5,), np.float64),
    )
    mapping = {
        "depth": "observations/arm/depth",
        "holding": "observations/arm/grip",
        "action": "actions",
        "success": "infos/won/all",
    }
    options = {"task": TASK, "env": ENV, "mapping": mapping}
    check_demonstrations(tmp_path / "theirs-v0", **options)
    (found,) = load_demonstrations(tmp_path / "theirs-v0", **options)
    np.testing.assert_array_equal(found["next", "depth"][:, 0], depth[1:])
    assert found["holding"].flatten().tolist() == [False, False, True]
    assert found["next", "success"].flatten().tolist() == [False, False, True]


def test_hdf5_has_the_layout_of_robomimic(episodes, tmp_path):
    with h5py.File(exported(tmp_path, episodes, "hdf5")) as file:
        assert file["data"].attrs["total"] == 9
        env_args = json.loads(file["data"].attrs["env_args"])
        assert env_args["env_name"] == "BulletArm/CloseLoopBlockPicking-v0"
        demo = file["data/demo_1"]
        assert demo.attrs["num_samples"] == 2
        assert demo["obs/wrist_rgb"].shape == demo["next_obs/wrist_rgb"].shape == (2, 48, 48, 3)
        assert demo["dones"][:].tolist() == [0, 1]
        assert demo["rewards"].shape == (2,)
        np.testing.assert_array_equal(demo["actions"], episodes[1]["action"])
        assert json.loads(demo.attrs["ep_meta"]) == {"lang": "pick up block 1"}
        # as robomimic's SequenceDataset reads `filter_by_attribute`
        masks = {name: [text.decode() for text in found[:]] for name, found in file["mask"].items()}
    assert masks == {"train": ["demo_0", "demo_1"], "valid": ["demo_2"]}


def test_a_tenth_of_the_episodes_is_for_validation():
    sizes = {n: [len(part) for part in _split(n).values()] for n in (1, 2, 10, 25)}
    assert sizes == {1: [1], 2: [1, 1], 10: [9, 1], 25: [23, 2]}
    assert _split(20)["valid"] == ["demo_9", "demo_19"]


@pytest.mark.parametrize("name", ["hdf5", "zarr"])
def test_texts_other_than_the_instruction_are_refused(name, collected, tmp_path):
    spoken = [episode.clone() for episode in collected]
    for each in spoken:
        for part in (each, each["next"]):
            part["spoken"] = NonTensorStack(*["please"] * len(each))
    with pytest.raises(ConfigError, match=f"spoken: the format '{name}' holds no text but instr"):
        exported(tmp_path, spoken, name)
    assert not list(tmp_path.iterdir())


def test_zarr_has_the_layout_of_diffusion_policy(episodes, tmp_path):
    root = zarr.open(str(exported(tmp_path, episodes, "zarr")), mode="r")
    assert root["meta/episode_ends"][:].tolist() == [3, 5, 9]
    assert root["data/wrist_rgb"].shape == (9, 48, 48, 3)
    np.testing.assert_array_equal(root["data/action"][3:5], episodes[1]["action"])


def test_lerobot_has_its_names(episodes, tmp_path):
    pytest.importorskip("lerobot")
    path = exported(tmp_path, episodes, "lerobot")
    features = json.loads((path / "meta/info.json").read_text())["features"]
    assert features["observation.state"]["names"] == ["holding", "empty"]
    assert features["observation.images.depth"]["shape"] == [3, SIZE, SIZE]
    assert features["action"]["names"] == ["gripper", "x", "y", "z", "yaw"]
    assert {"next.reward", "next.done", "next.success"} <= features.keys()
    assert not [
        folder for folder in path.rglob("*") if folder.is_dir() and not any(folder.iterdir())
    ]


class Recorder:
    """LeRobot's writer: it refuses the frames that LeRobot 0.6 refuses."""

    def __init__(self):
        self.frames, self.ends, self.were_silent = [], [], []

    def create(self, *, repo_id, fps, features, root, robot_type, use_videos, video_backend):
        self.features = features
        (root / "meta").mkdir(parents=True)
        (root / "images/observation.images.depth").mkdir(parents=True)
        (root / "meta/info.json").write_text("{}")
        return self

    def add_frame(self, frame):
        assert frame.keys() == {*self.features, "task"}
        for name, feature in self.features.items():
            assert frame[name].shape == feature["shape"], name
            dtype = "uint8" if feature["dtype"] == "image" else feature["dtype"]
            assert frame[name].dtype == dtype, name
        self.frames.append(frame)

    def save_episode(self):
        self.ends.append(len(self.frames))
        self.were_silent.append(not self.bars)

    bars = True

    def are_progress_bars_disabled(self):
        return not self.bars

    def disable_progress_bars(self):
        self.bars = False

    def enable_progress_bars(self):
        self.bars = True

    def finalize(self):
        assert self.ends


@pytest.fixture
def recorder(monkeypatch):
    recorder = Recorder()
    module = SimpleNamespace(LeRobotDataset=recorder)
    monkeypatch.setitem(sys.modules, "lerobot.datasets.lerobot_dataset", module)
    monkeypatch.setitem(sys.modules, "datasets", recorder)
    return recorder


def test_lerobot_is_given_what_its_policies_train_on(collected, tmp_path, recorder):
    path = exported(tmp_path, collected, "lerobot")
    check_features({name: each for name, each in recorder.features.items() if "info" in each})
    steps = [len(episode) for episode in collected]
    assert recorder.ends == [steps[0], sum(steps)]
    assert recorder.were_silent == [True, True]
    assert recorder.bars
    first = recorder.frames[0]
    assert first["task"] == "pick up the red block"
    np.testing.assert_array_equal(first["action"], collected[0]["action"][0])
    assert sorted(file.name for file in path.iterdir()) == [
        "README.md",
        "card.json",
        "meta",
        "observations.npz",
    ]
    page = (path / "README.md").read_text()
    for words in (
        "| `action` | gripper, x, y, z, yaw | gripper: 1 opens, -1 closes; x, y, z: 1 moves by",
        "| `observation.images.depth` | 3 x 64 x 64 | 0 m (0) to 0.39 m (255) | workspace, rows +x",
        "--policy.type=act --policy.chunk_size=16",
        "--policy.optimizer_lr=1e-4 --policy.optimizer_lr_backbone=1e-4",
        "--policy.type=diffusion --policy.horizon=16 --policy.use_group_norm=true",
        "--env.task=close_loop/block_picking",
        """--env.parameters='{"obs_size": 64}'""",
        "ba-torchrl evaluate policy=lerobot:",
    ):
        assert words in page


def test_rows_of_the_file_beside_that_do_not_fit_are_refused(collected, tmp_path, recorder):
    path = exported(tmp_path, collected, "lerobot")
    without_checksums(path)
    start, read = 0, []
    for end in recorder.ends:
        frames, start = recorder.frames[start:end], end
        read.append({name: np.array([frame[name] for frame in frames]) for name in frames[0]})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(FORMATS["lerobot"]), "read", lambda *_: read)
        assert_equal(load_demonstrations(path, task=TASK, env=ENV), collected)
        read[0]["action"] = read[0]["action"][:-1]
        with pytest.raises(ConfigError, match=r"observations.npz has \d+ rows of exact\."):
            load_demonstrations(path, task=TASK, env=ENV)


def test_chosen_observations_and_pictures(collected, tmp_path):
    path = exported(tmp_path, collected, "hdf5", observed=["depth"])
    with h5py.File(path) as file:
        assert list(file["data/demo_0/obs"]) == ["depth"]
    with pytest.raises(ConfigError, match=r"was exported without holding, which .* observes"):
        load_demonstrations(path, task=TASK, env=ENV)
    for name, changes, message in (
        ("zarr", {"cameras": ["depth"]}, "cameras: the format zarr has none; choose images by"),
        ("zarr", {"observed": ["rgb"]}, r"unknown observation 'rgb'\. Known: depth, holding"),
        ("lerobot", {"cameras": ["holding"]}, r"unknown camera 'holding'\. Known: depth"),
        ("lerobot", {"observed": ["depth"], "cameras": ["rgb"]}, "unknown camera 'rgb'"),
        ("lerobot", {"observed": ["depth"]}, "ACT and Diffusion read a state such as holding: "),
        ("lerobot", {"cameras": []}, "read a picture or the poses of objects, beside holding: "),
    ):
        with pytest.raises(ConfigError, match=message):
            exported(tmp_path, collected, name, **changes)


def edit_table(file, change):
    """Rewrite a parquet file with the rows, columns and types that ``change`` returns."""
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(file)
    parquet.write_table(change(table), file)


@pytest.mark.parametrize("order", [[1, 0, 2], [2, 1, 0]])
def test_lerobot_rows_are_read_in_the_order_of_their_frames(order, episodes, tmp_path):
    pytest.importorskip("lerobot")
    path = exported(tmp_path, episodes, "lerobot")
    without_checksums(path)
    edit_table(path / LEROBOT_DATA, lambda table: table.take([*order, *range(3, len(table))]))
    assert_equal(load_demonstrations(path, task=TASK, env=ENV), episodes)


LEROBOT_DATA = "data/chunk-000/file-000.parquet"


def without_checksums(path):
    card = path / "card.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), "checksums": {}}))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (LEROBOT_DATA, "data/chunk-000/file-000.parquet is missing; copy it again"),
        ("meta/tasks.parquet", "is incomplete: .*tasks.parquet.*; copy it again with all"),
        ("meta/episodes/chunk-000/file-000.parquet", "is incomplete: .*meta/episodes"),
        ({"total_episodes": 2}, r"counts 2 episodes \(total_episodes\), and meta/episodes has 3"),
        ({"total_episodes": 10**12}, "counts 1000000000000 episodes"),
        ({"total_frames": 8}, "counts 8 frames .*, and data/ has 9"),
        ([*range(9), 8], "and data/ has 10"),
        ([*range(5)], r"data/ lacks episodes of meta/"),
        ([0, 1, 1, *range(3, 9)], r"episode 0: frame_index is 0, 1, 1, needed each number from 0"),
    ],
)
def test_lerobot_folders_with_lost_files_or_numbers_are_refused_without_the_hub(
    damage, message, episodes, tmp_path, monkeypatch
):
    pytest.importorskip("lerobot")
    path = exported(tmp_path, episodes, "lerobot")
    without_checksums(path)
    if isinstance(damage, str):
        (path / damage).unlink()
    elif isinstance(damage, dict):
        info = path / "meta/info.json"
        info.write_text(json.dumps({**json.loads(info.read_text()), **damage}))
    else:
        edit_table(path / LEROBOT_DATA, lambda table: table.take(damage))
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.exit("the network was used"))
    with pytest.raises(ConfigError, match=message):
        load_demonstrations(path, task=TASK, env=ENV)


POSED = {**ENV, "observations": ["proprio", "joints"], "point_cloud": 4}


def posed(path, **changes):
    """Write two episodes in which a gripper follows its actions; changes are of their arrays."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for i in range(2):
            action = rng.uniform(-1, 1, (6, 5)) * [1, 0.3, 0.3, 0.3, 0.9]
            holding = np.array([0, 0, 0, 1, 1, 1, 1])[:, None]
            action[:, 0] = np.where(holding[1:, 0], -1, 1)
            moved = np.cumsum(np.r_[np.zeros((1, 5)), action], axis=0)
            half = (moved[:, 4] * np.pi / 4 / 2)[:, None]
            turn = np.c_[np.cos(half), np.sin(half), 0 * half, 0 * half]
            turn *= np.where(turn[:, :1] < 0, -1, 1)
            data = {
                "depth": rng.uniform(0.1, 0.2, (7, 1, SIZE, SIZE)),
                "holding": holding,
                "proprio": np.c_[[0.45, 0, 0.1] + moved[:, 1:4] * 0.05, turn, 1 - holding],
                "joints": rng.uniform(-2, 2, (7, 7)),
                "point_cloud": rng.uniform(0.3, 0.4, (7, 4, 3)) * [1, 0, 1],
                "action": action,
            }
            for name, rows in data.items():
                change = changes.get(name, lambda given, _: given)
                file[f"data/demo_{i}/{name}"] = change(rows, data)
    return path


def read_posed(path):
    keys = ("depth", "holding", "proprio", "joints", "point_cloud", "action")
    return load_demonstrations(path, task=TASK, env=POSED, mapping={key: key for key in keys})


def times(*factors):
    return lambda given, _: given * factors


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"proprio": lambda given, _: given[:, [0, 1, 2, 6, 3, 4, 5, 7]]},
            r"proprio: .* tilted by up to .* w, x, y, z .* have \[4, 5, 6, 3\] in place of \[3, 4",
        ),
        (
            {"proprio": lambda given, _: given[:, [0, 1, 2, 5, 6, 3, 4, 7]]},
            "proprio: .* tilted by up to 180 degrees, .*; check the frame and the order",
        ),
        ({"proprio": times(1, 1, 1, 0.5, 0.5, 0.5, 0.5, 1)}, "lengths from 0.5 to 0.5, needed 1"),
        ({"proprio": times(1e3, 1e3, 1e3, 1, 1, 1, 1, 1)}, r"proprio: x has .*-2 to 2 \(metres"),
        (
            {"proprio": times(1, 1, 1, 1, 1, 1, 1, 255)},
            "opening has values from 0 to 255, needed 0",
        ),
        ({"joints": times(*[57.3] * 7)}, r"joints: joint \d has .* to 6.28319 \(radians\)"),
        ({"point_cloud": times(1e3, 1e3, 1e3)}, r"point_cloud: x has .*needed .*\(metres\)"),
    ],
)
def test_foreign_units_and_orders_are_refused_by_the_declaration(changes, message, tmp_path):
    with pytest.raises(ConfigError, match=f"episode 0: .*{message}"):
        read_posed(posed(tmp_path / "a.hdf5", **changes))


def test_the_sign_of_foreign_quaternions_becomes_that_of_the_declaration(tmp_path, caplog):
    wanted = read_posed(posed(tmp_path / "a.hdf5"))
    negated = posed(tmp_path / "b.hdf5", proprio=times(1, 1, 1, -1, -1, -1, -1, 1))
    assert_equal(read_posed(negated), wanted)
    assert caplog.messages == []


def with_zeros(share):
    def change(given, _):
        rows = round(share * SIZE)
        return given * (np.arange(SIZE)[:, None] >= rows)

    return change


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"action": times(-1, 1, 1, 1, 1)},
            "in 100% of the steps .* remains held, the action opens",
        ),
        (
            {
                "action": lambda given, data: np.c_[
                    given[:, :1], data["proprio"][1:, :3], given[:, 4:]
                ]
            },
            "explain 0% of the gripper's motion; are they absolute positions",
        ),
        ({"action": times(1, 1, 1, 1, -1)}, "explain 0% of the gripper's turns; check their sign"),
        (
            {"proprio": lambda given, _: np.c_[given[:, :3], given[:, [4, 3, 5, 6, 7]]]},
            "explain 0% of the gripper's turns; .* the order x, y, z, w",
        ),
        ({"depth": with_zeros(0.3)}, "30 % of depth is 0 m, .* at most 10 %"),
        ({"depth": with_zeros(0.05)}, None),
        (
            {"point_cloud": lambda given, _: given * (np.arange(4)[:, None] > 0)},
            "25 % of point_cloud",
        ),
    ],
)
def test_contradictions_and_missing_returns_are_warnings(changes, message, tmp_path, caplog):
    read_posed(posed(tmp_path / "a.hdf5", **changes))
    assert bool(caplog.messages) == (message is not None)
    assert message is None or re.search(message, caplog.messages[0])


def test_actions_tell_of_themselves_and_of_what_is_held():
    far = {"action": np.tile([1, 0.45, 0, 0.1, 0], (20, 1)), "holding": np.zeros((21, 1), bool)}
    (message,) = contradictions([far, far], resolve_env(TASK, ENV))
    assert "add up to more than the workspace; are the actions absolute positions?" in message
    steps = np.arange(5)[:, None]
    turns = {"action": np.c_[steps[:4] % 2 == 0, np.zeros((4, 3))], "holding": steps % 2 == 1}
    stacking = resolve_env("open_loop/block_stacking", {})
    (message,) = contradictions([turns], stacking)
    assert "100% of the actions pick while an object is held, or place without one" in message
    assert [*contradictions([{**turns, "holding": steps % 2 == 0}], stacking)] == []


# Another robot's teleoperation: depth in millimetres with channels last, an action of
# (x, y, z, yaw, gripper) in metres, radians and opening.
FOREIGN = {
    "depth": {"source": "obs/depth", "scale": 0.001},
    "holding": {"source": "obs/state", "components": [1], "scale": -1, "offset": 1},
    "action": {
        "source": "actions",
        "components": [4, 0, 1, 2, 3],
        "scale": [2, 20, 20, 20, 1],
        "offset": [-1, 0, 0, 0, 0],
    },
}


def foreign(path, **changes):
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for i, steps in enumerate((3, 2)):
            data = {
                "obs/depth": rng.integers(0, 200, (steps, SIZE, SIZE, 1), dtype=np.uint16),
                "obs/state": np.array([[0.1, 0.2], [0.3, 0.9], [0.6, 0.4]]),
                "actions": rng.uniform(0, 0.05, (steps, 5)),
                **changes,
            }
            for name, rows in data.items():
                file[f"data/demo_{i}/{name}"] = rows[:steps]
    return path


@pytest.mark.parametrize("as_file", [False, True])
def test_demonstrations_of_another_robot_are_mapped(as_file, tmp_path):
    path = foreign(tmp_path / "teleoperation.hdf5")
    mapping = FOREIGN
    if as_file:
        mapping = tmp_path / "mapping.yaml"
        mapping.write_text(json.dumps(FOREIGN))  # JSON is YAML
    first, second = load_demonstrations(path, task=TASK, env=ENV, mapping=mapping)
    with h5py.File(path) as file:
        demo = file["data/demo_0"]
        depth, action = demo["obs/depth"][:], demo["actions"][:]
    pixels = torch.from_numpy(depth.transpose(0, 3, 1, 2) * 0.001).float()
    assert torch.equal(first["depth"], pixels)
    assert torch.equal(first["next", "depth"], torch.cat([pixels[1:], pixels[-1:]]))
    assert first["holding"].flatten().tolist() == [True, False, True]
    wanted = np.c_[action[:, 4] * 2 - 1, action[:, :3] * 20, action[:, 3]]
    np.testing.assert_allclose(first["action"], wanted, rtol=1e-6)
    assert second["next", "success"].flatten().tolist() == [False, True]
    assert second["next", "terminated"].flatten().tolist() == [False, True]
    assert second["next", "reward"].flatten().tolist() == [0, 1]
    env = ba_torchrl.make(TASK, seed=0, **ENV)
    plain = env.rollout(2)
    env.close()
    assert set(first.keys(True, True)) == set(plain.keys(True, True))
    for key in plain.keys(True, True):
        assert first[key].dtype == plain[key].dtype, key
        assert first[key].shape[1:] == plain[key].shape[1:], key


@pytest.mark.parametrize(
    ("results", "success", "terminated"),
    [
        ({"success": "won"}, True, True),
        ({"reward": "won"}, True, True),
        ({"terminated": "won"}, True, True),
        ({"success": "won", "terminated": "never"}, True, True),
        ({"success": "won", "reward": "won", "truncated": "won"}, True, True),
        ({"success": "never", "terminated": "won"}, False, True),
        ({"success": "never", "truncated": "won"}, False, False),
    ],
)
def test_an_episode_ends_at_its_first_success_or_end(
    results, success, terminated, tmp_path, caplog
):
    path = foreign(tmp_path / "a.hdf5", won=np.array([0, 1, 1]), never=np.zeros(3))
    mapping = {**FOREIGN, **results}
    check_demonstrations(path, task=TASK, env=ENV, mapping=mapping)
    assert caplog.messages == []
    first, second = load_demonstrations(path, task=TASK, env=ENV, mapping=mapping)
    assert caplog.messages == [
        f"{path}: 1 of 5 steps are left out, those after the first success or end of an episode"
    ]
    whole, _ = load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)
    assert torch.equal(first["next", "depth"], whole["next", "depth"][:2])
    for each in (first, second):
        following = each["next"]
        assert following["done"].flatten().tolist() == [False, True]
        assert following["reward"].flatten().tolist() == [0, float(success)]
        assert following["success"].flatten().tolist() == [False, success]
        assert following["terminated"].flatten().tolist() == [False, terminated]


def test_rewards_without_success_tell_it(tmp_path, caplog):
    path = foreign(tmp_path / "a.hdf5", rewards=np.array([0, 0, 1]), zero=np.zeros(3))
    options = {"task": TASK, "env": ENV}
    found = load_demonstrations(path, mapping={**FOREIGN, "reward": "rewards"}, **options)
    assert [each["next", "success"].sum() for each in found] == [1, 0]
    assert caplog.messages == []
    found = load_demonstrations(path, mapping={**FOREIGN, "reward": "zero"}, **options)
    assert [each["next", "success"].sum() for each in found] == [1, 1]
    (message,) = caplog.messages
    assert "the rewards are all 0, and every episode counts as a success: map success" in message


def test_a_constant_entry_is_named(tmp_path, caplog):
    path = foreign(tmp_path / "a.hdf5", still=np.zeros((3, 5)))
    load_demonstrations(path, task=TASK, env=ENV, mapping={**FOREIGN, "action": "still"})
    assert caplog.messages == [f"{path}: action is 0 in all steps; is it the right entry?"]


def test_an_episode_of_a_task_that_terminates_at_its_limit_is_terminated():
    arrays = {"action": np.zeros((2, 4)), "success": np.zeros((2, 1))}
    found = with_results(arrays, resolve_env("open_loop/object_grasping", {}))
    assert found["terminated"].tolist() == [[False], [True]]
    assert not found["truncated"].any()


RESULTS = {
    "won": np.array([0, 1, 1]),
    "late": np.array([0, 0, 1]),
    "half": np.array([0, 0.3, 0.6]),
    "minus": np.array([-1, -1, 0]),
    "nan": np.array([0, np.nan, 1]),
    "pairs": np.array([[0, 1]] * 3),
    "bytes": np.array([b"no", b"no", b"yes"]),
    "words": ["push", "lift", "lift"],
    "empty": [""] * 3,
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"holding": None}, "the mapping has no holding"),
        ({"gripper": "obs/state"}, "the environment has no gripper. Known: .*holding"),
        ({"holding": "obs/grip"}, "episode 0: holding: there is no 'obs/grip'. Known: .*obs/state"),
        ({"holding": "obs/state"}, r"holding: has the shape \[2\], needed \[1\]"),
        ({"depth": "obs/depth"}, r"depth: has values from 0 to 199, needed .*; set scale"),
        ({"action": {"source": "actions", "offset": -3}}, "action: has values from -2.99"),
        ({"action": {"source": "actions", "components": [9]}}, "action: actions.* not among its 5"),
        ({"action": {"source": "actions", "scale": [1, 2]}}, "action: actions.*broadcast"),
        ({"action": {"sauce": "actions"}}, r"mapping: action:\n  source: is missing\n.*'source'"),
        ({"action": {"source": "actions", "scale": "x"}}, "scale: must be a number, or a list"),
        ({"instruction": "obs/state"}, "episode 0: instruction: is no text"),
        ({"instruction": "words"}, r"instruction: found \['lift', 'push'\], needed one sentence"),
        ({"instruction": "empty"}, r"instruction: found \[''\], needed one sentence"),
        ({"success": "half"}, r"success: has values from 0 to 0\.6, needed 0 or 1"),
        ({"reward": "minus"}, "reward: has values from -1 to 0, needed 0 or 1; set scale"),
        ({"success": "won", "reward": "late"}, "step 1 of 2 has the reward 0 and the success 1"),
        ({"success": "late", "reward": "won"}, "step 1 of 3 has the reward 1 and the success 0"),
        ({"success": {"source": "won", "components": [0]}}, "success: won.* not among its 0"),
        ({"reward": "nan"}, "reward: .*no finite numbers"),
        ({"success": "pairs"}, r"success: .*has the shape \[2\], .*; set components"),
        ({"terminated": "bytes"}, "terminated: .*no finite numbers; .*set components"),
        ({"truncated": "nan"}, "truncated: .*no finite numbers"),
    ],
)
def test_mappings_and_results_that_do_not_fit_are_refused_by_name(changes, message, tmp_path):
    path = foreign(tmp_path / "a.hdf5", **RESULTS)
    mapping = {key: value for key, value in {**FOREIGN, **changes}.items() if value is not None}
    with pytest.raises(ConfigError, match=message):
        load_demonstrations(path, task=TASK, env=ENV, mapping=mapping)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_colours_between_0_and_1_are_scaled_and_rounded(dtype, tmp_path):
    env = {**ENV, "observations": ["wrist_rgb"]}
    colours = np.random.default_rng(0).integers(0, 256, (3, SIZE, SIZE, 3), dtype=np.uint8)
    path = foreign(tmp_path / "a.hdf5", rgb=(colours / 255).astype(dtype))
    for source in ("rgb", {"source": "rgb", "scale": 1.0}):
        with pytest.raises(ConfigError, match=r"wrist_rgb: has values from 0 to 1, .*scale: 255"):
            load_demonstrations(path, task=TASK, env=env, mapping={**FOREIGN, "wrist_rgb": source})
    mapping = {**FOREIGN, "wrist_rgb": {"source": "rgb", "scale": 255}}
    first, _ = load_demonstrations(path, task=TASK, env=env, mapping=mapping)
    np.testing.assert_array_equal(first["wrist_rgb"], colours.transpose(0, 3, 1, 2))


def test_links_in_hdf5_are_followed(tmp_path):
    path = foreign(tmp_path / "a.hdf5")
    wanted = load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)
    with h5py.File(path, "a") as file:
        for name, demo in file["data"].items():
            file.move(f"data/{name}/obs/depth", f"images/{name}")
            demo["obs/depth"] = h5py.SoftLink(f"/images/{name}")
            demo["obs/second"] = demo["actions"]  # a hard link
            demo["obs/loop"] = h5py.SoftLink(f"/data/{name}")
            demo["obs/lost"] = h5py.SoftLink("/nowhere")
            demo["obs/elsewhere"] = h5py.ExternalLink("none.hdf5", "/a")
    mapping = {**FOREIGN, "action": {**FOREIGN["action"], "source": "obs/second"}}
    check_demonstrations(path, task=TASK, env=ENV, mapping=mapping)
    assert_equal(load_demonstrations(path, task=TASK, env=ENV, mapping=mapping), wanted)


def test_hdf5_is_read_where_it_is_mapped_and_checked_by_shapes(tmp_path, monkeypatch):
    path = foreign(tmp_path / "a.hdf5")
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            demo.create_dataset("obs/camera", (3, 1 << 20, 1 << 20), "f8", chunks=(1, 64, 64))
            demo["obs/nothing"] = h5py.Empty("f4")
            demo.attrs["ep_meta"] = h5py.Empty("f4")
        file["data/note"] = np.arange(3)
    assert len(load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)) == 2
    read = []
    monkeypatch.setattr(base, "plain", lambda values: read.append(values))
    check_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)
    assert read == []
    for changes, message in (
        ({"depth": "obs/camera"}, "depth: 805306368 of 805306368 parts of .*camera were never"),
        ({"depth": "obs/state"}, r"depth: has the shape \[2\], needed"),
        ({"success": "obs/nothing"}, "success has 0 rows, and there are 3 actions"),
        ({"reward": "obs/state"}, r"reward: has the shape \[2\], needed \[1\]; set components"),
        ({"instruction": "ep_meta/lang"}, "instruction: there is no 'ep_meta/lang'"),
    ):
        with pytest.raises(ConfigError, match=f"episode 0: {message}"):
            check_demonstrations(path, task=TASK, env=ENV, mapping={**FOREIGN, **changes})


def never_written(demo, how):
    """Replace `obs/depth` of an episode by a dataset of which a part was never written."""
    depth = demo["obs/depth"][:]
    del demo["obs/depth"]
    options = {"name": "obs/depth", "shape": depth.shape, "dtype": depth.dtype}
    if how == "next":
        demo["obs/depth"] = depth
        demo.create_dataset(**{**options, "name": "next_obs/depth"})
    elif how == "chunk":
        demo.create_dataset(**options, chunks=(1, *depth.shape[1:]))[: len(depth) - 1] = depth[:-1]
    elif how == "all":
        demo.create_dataset(**options)
    elif how == "external":
        demo.create_dataset(**options, external="/dev/zero")
    else:
        layout = h5py.VirtualLayout(shape=depth.shape, dtype=depth.dtype)
        sources = {"lost": "none.hdf5", "part": ".", "whole": "."}
        demo["stored"] = depth
        source = h5py.VirtualSource(sources[how], f"{demo.name}/stored", depth.shape)
        rows = len(depth) - (how == "part")
        layout[:rows] = source[:rows]
        demo.create_virtual_dataset("obs/depth", layout)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("chunk", r"1 of 3 parts of /data/demo_0/obs/depth were never written.* as 0"),
        ("all", "1 of 1 parts of /data/demo_0/obs/depth were never written"),
        ("next", "1 of 1 parts of /data/demo_0/next_obs/depth were never written"),
        ("external", "the values of /data/demo_0/obs/depth are in other files"),
        (
            "lost",
            "/data/demo_0/stored of .*none.hdf5, a part of /data/demo_0/obs/depth, is missing",
        ),
        ("part", "4096 of 12288 values of /data/demo_0/obs/depth have no source"),
        ("whole", None),
    ],
)
def test_parts_of_hdf5_that_were_never_written_are_refused(how, message, tmp_path):
    path = foreign(tmp_path / "a.hdf5")
    with h5py.File(path, "a") as file:
        never_written(file["data/demo_0"], how)
        file["data/demo_0/unused"] = np.zeros((3, 5))
    for read in (check_demonstrations, load_demonstrations):
        if message is None:
            read(path, task=TASK, env=ENV, mapping=FOREIGN)
            continue
        with pytest.raises(ConfigError, match=f"episode 0: depth: {message}"):
            read(path, task=TASK, env=ENV, mapping=FOREIGN)


def test_numbers_of_a_file_agree(tmp_path, collected):
    path = foreign(tmp_path / "a.hdf5")
    with h5py.File(path, "a") as file:
        file["data/demo_1"].attrs["num_samples"] = 3
    with pytest.raises(ConfigError, match="demo_1 has 2 actions, and its num_samples is 3"):
        load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)
    path = exported(tmp_path, collected, "minari")
    mapping = {name: f"observations/{name}" for name in ("depth", "holding")}
    options = {"task": TASK, "env": ENV, "mapping": {**mapping, "action": "actions"}}
    assert len(load_demonstrations(path, **options)) == 2
    metadata = path / "data/metadata.json"
    text = metadata.read_text()
    for count in ("1", "3", str(10**12)):
        metadata.write_text(text.replace('"total_episodes": 2', f'"total_episodes": {count}'))
        with pytest.raises(ConfigError, match=f"holds 2 episodes, .*json counts {count}"):
            load_demonstrations(path, **options)
    metadata.write_text(text)
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        file["episode_1/actions"].resize((10**7, 5))
    with pytest.raises(ConfigError, match=r"main_data\.hdf5: .* parts of /episode_1/actions were"):
        load_demonstrations(path, **options)


@pytest.mark.parametrize(
    "names", [("ends", "cuts"), ("ends",), ("cuts",), ("ends", "cuts", "wins"), ("wins",)]
)
def test_an_episode_whose_file_marks_no_end_is_truncated(names, tmp_path):
    path = foreign(tmp_path / "a.hdf5", ends=np.zeros(3), cuts=np.zeros((3, 1)), wins=np.zeros(3))
    keys = {"ends": "terminated", "cuts": "truncated", "wins": "success"}
    mapping = {**FOREIGN, **{keys[name]: name for name in names}}
    first, _ = load_demonstrations(path, task=TASK, env=ENV, mapping=mapping)
    is_truncated = "wins" in names  # else the success of the last step terminates
    last = first["next"][-1]
    assert (last["truncated"].item(), last["terminated"].item()) == (is_truncated, not is_truncated)
    assert first["next", "done"].flatten().tolist() == [False, False, True]


def test_what_the_expert_would_do_next_is_left_out(episodes, tmp_path):
    shapes = {"expert_moves": (4, 5), "expert_chunk": (3, 5), "expert_chunk_mask": (3,)}
    more = [
        episode.clone().update({k: torch.zeros(len(episode), *v) for k, v in shapes.items()})
        for episode in episodes
    ]
    path = exported(tmp_path, more, "hdf5")
    assert_equal(load_demonstrations(path, task=TASK, env=ENV), episodes)


def test_files_beside_an_export_are_left_alone(episodes, tmp_path):
    others = [tmp_path / "picking.json", tmp_path / "picking.md"]
    for file in others:
        file.write_text("mine")
    path = exported(tmp_path, episodes, "hdf5")
    assert [file.read_text() for file in others] == ["mine", "mine"]
    assert_equal(load_demonstrations(path, task=TASK, env=ENV), episodes)
    with pytest.raises(ConfigError, match=r"picking could not be read back; end .* in \.hdf5"):
        export_demonstrations(
            tmp_path / "picking", episodes, format="hdf5", task=TASK, env=ENV, seed=0
        )
    assert not (tmp_path / "picking").exists()


def test_cards_of_others_are_not_read(tmp_path):
    path = foreign(tmp_path / "a.hdf5")
    card = tmp_path / "a.hdf5.card.json"
    for text in ("[]", "{}", '{"format": "theirs"}'):
        card.write_text(text)
        with pytest.raises(ConfigError, match="written by another program"):
            load_demonstrations(path, task=TASK, env=ENV)
    for text in ("no JSON", '{"format": "hdf5", "entries": {}, "card_format": 3}'):
        card.write_text(text)
        with pytest.raises(ConfigError, match="is damaged"):
            load_demonstrations(path, task=TASK, env=ENV)
        assert len(load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)) == 2


@pytest.mark.parametrize("text", [["pick ü"] * 3, np.array([b"pick"] * 3), "pick"])
def test_instructions_of_any_kind_of_text_are_read(text, tmp_path):
    path = tmp_path / "a.hdf5"
    foreign(path)
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            demo["lang"] = text
    with pytest.raises(ConfigError, match=r"It holds .*lang \[\]"):
        load_demonstrations(path, task=TASK, env=ENV)
    mapping = {**FOREIGN, "instruction": "lang"}
    found = load_demonstrations(path, task=TASK, env=ENV, mapping=mapping)
    wanted = "pick ü" if isinstance(text, list) else "pick"
    assert found[0]["instruction"] == [wanted] * 3


def test_dense_rewards_are_not_made_up(tmp_path):
    path = foreign(tmp_path / "a.hdf5", progress=np.array([0.1, 0.2, 1.0]), over=np.zeros(3))
    options = {"task": TASK, "env": {**ENV, "reward": "dense"}}
    with pytest.raises(ConfigError, match="the mapping has no reward, terminated"):
        load_demonstrations(path, mapping=FOREIGN, **options)
    results = {"reward": "progress", "terminated": "over"}
    found = load_demonstrations(path, mapping={**FOREIGN, **results}, **options)[0]["next"]
    assert found["reward"].flatten().tolist() == pytest.approx([0.1, 0.2, 1.0])
    assert found["truncated"].flatten().tolist() == [False, False, True]


def test_episodes_that_differ_are_not_exported(episodes, tmp_path):
    with pytest.raises(
        ConfigError, match=r"episode 0: depth .*\[1, 64, 64\], needed \[1, 128, 128\]"
    ):
        exported(tmp_path, episodes, "hdf5", env={})
    with pytest.raises(ConfigError, match="episode 1 has no steps"):
        exported(tmp_path, [episodes[0], episodes[1][:0]], "hdf5")
    odd = [episodes[0], episodes[1].exclude("proprio", ("next", "proprio"))]
    with pytest.raises(ConfigError, match="episode 1 has no proprio"):
        exported(tmp_path, odd, "hdf5")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda card: card["entries"].pop("action"), "is damaged: .*entries lack action"),
        (lambda card: card["entries"]["depth"].update(dtype="foo"), "depth has the unknown type"),
        (lambda card: card["entries"]["depth"].update(dtype="O"), "depth has the unknown type"),
        (lambda card: card.update(seed="x"), "is damaged: seed: "),
        (lambda card: card.update(card_format=2), "is of another version; export .* again"),
        (lambda card: card.update(task_version=7), "task_version: collected with 7, needed "),
        (lambda card: card.update(episodes=7), "holds 3 episodes, its card says 7"),
        (lambda card: card["entries"]["proprio"].update(name="no"), "episode 0: .* no 'no', which"),
    ],
)
def test_a_card_that_does_not_fit_its_file_is_refused(damage, message, episodes, tmp_path):
    path = exported(tmp_path, episodes, "hdf5")
    file = path.with_name(f"{path.name}.card.json")
    card = json.loads(file.read_text())
    damage(card)
    file.write_text(json.dumps(card))
    with pytest.raises(ConfigError, match=message):
        load_demonstrations(path, task=TASK, env=ENV)


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("hdf5", "picking.hdf5", "picking.hdf5 was altered: .* delete 'checksums' in .*card.json"),
        ("zarr", "picking.zarr/data/reward/0.0", "reward/0.0 was altered"),
        (
            "zarr",
            "picking.zarr/last_observations.safetensors",
            "observations.safetensors is missing",
        ),
        ("minari", "picking-v0/data/main_data.hdf5", "main_data.hdf5 is missing"),
        ("minari", "picking-v0/data/metadata.json", "metadata.json is missing"),
        ("zarr", "picking.zarr/.zgroup", ".zgroup is missing"),
    ],
)
def test_an_export_that_was_altered_is_refused(name, damage, message, collected, tmp_path):
    path = exported(tmp_path, collected, name)
    file = tmp_path / damage
    content = file.read_bytes()
    file.unlink()
    if "altered" in message:
        file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    for read in (check_demonstrations, load_demonstrations):
        with pytest.raises(DamagedFilesError, match=message):
            read(path, task=TASK, env=ENV)


def zarr_group(path, version=2):
    """Return a new group in a folder, of a version of the format."""
    if version == 2 and zarr.__version__.startswith("2."):
        return zarr.open_group(str(path), mode="w")
    return zarr.open_group(str(path), mode="w", zarr_format=version)


def foreign_zarr(path, version=2, **changes):
    """Write two episodes of 3 and 2 steps, every chunk of them."""
    rng = np.random.default_rng(0)
    arrays = {
        "data/camera/depth": rng.uniform(0.1, 0.2, (5, SIZE, SIZE)).astype(np.float32),
        "data/state": np.linspace(0, 1, 10).reshape(5, 2),
        "data/action": rng.uniform(-1, 1, (5, 5)),
        "data/success": np.array([0, 0, 1, 0, 0]),
        "meta/episode_ends": np.array([3, 5]),
        **changes,
    }
    root = zarr_group(path, version)
    for name, rows in arrays.items():
        store_zarr(root, name, rows)
    return path


def store_zarr(root, name, rows):
    options = {"shape": rows.shape, "dtype": rows.dtype, "chunks": (2, *rows.shape[1:])}
    options["overwrite"] = True
    if hasattr(root, "create_array"):
        array = root.create_array(name, **options, config={"write_empty_chunks": True})
    else:
        array = root.create_dataset(name, **options)
    array[:] = rows


ZARR = {
    "depth": "camera/depth",
    "holding": {"source": "state", "components": [1]},
    "action": "action",
    "success": "success",
}


def zipped(folder):
    archive = folder.with_name(f"{folder.name}.zip")
    with zipfile.ZipFile(archive, "w") as file:
        for path in filter(Path.is_file, folder.rglob("*")):
            file.write(path, path.relative_to(folder))
    return archive


needs_zarr_3 = pytest.mark.skipif(zarr.__version__.startswith("2."), reason="zarr 3")
VERSIONS = [2, pytest.param(3, marks=needs_zarr_3)]


@pytest.mark.parametrize("is_zip", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
def test_groups_and_archives_of_zarr_are_read(version, is_zip, tmp_path):
    path = foreign_zarr(tmp_path / "a.zarr", version, **{"data/note": np.arange(7)})
    depth = zarr.open_group(str(path), mode="r")["data/camera/depth"][:]
    path = zipped(path) if is_zip else path
    check_demonstrations(path, task=TASK, env=ENV, least=2, mapping=ZARR)
    first, second = load_demonstrations(path, task=TASK, env=ENV, mapping=ZARR)
    np.testing.assert_array_equal(first["depth"][:, 0], depth[:3])
    np.testing.assert_array_equal(second["depth"][:, 0], depth[3:])
    assert first["next", "success"].flatten().tolist() == [False, False, True]
    assert not second["next", "success"].any()
    with pytest.raises(ConfigError, match=r"data/note has the shape \[7\], the episodes end at"):
        load_demonstrations(path, task=TASK, env=ENV, mapping={**ZARR, "reward": "note"})


@pytest.mark.parametrize("is_zip", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", ["data/camera/depth", "data/action", "data/success"])
def test_a_missing_chunk_of_zarr_is_refused(name, version, is_zip, tmp_path):
    path = foreign_zarr(tmp_path / "a.zarr", version)
    chunks = sorted(
        file for file in (path / name).rglob("*") if file.name[0].isdecimal() and file.is_file()
    )
    chunks[-1].unlink()
    if not is_zip:
        chunks[-1].mkdir()  # is no chunk
    mapped = zipped(path) if is_zip else path
    for read in (check_demonstrations, load_demonstrations):
        with pytest.raises(ConfigError, match=rf"number 3 of 3, of {name} is missing; .*Copy"):
            read(mapped, task=TASK, env=ENV, mapping=ZARR)
    if name == "data/success":
        others = {key: source for key, source in ZARR.items() if key != "success"}
        assert len(load_demonstrations(mapped, task=TASK, env=ENV, mapping=others)) == 2


def test_a_zarr_folder_without_its_ends_is_refused(tmp_path):
    path = foreign_zarr(tmp_path / "a.zarr")
    options = {"task": TASK, "env": ENV, "mapping": ZARR}
    for ends, message in (
        ([3, 4], r"has the shape \[5.*end at \[4\]"),
        ([3, 3], "do not rise"),
        ([3, 6.7], "episode_ends: the end 6.7 is no whole number of steps"),
        ([3, np.nan], "the end nan is no"),
        ([*range(1, 7)], "6 episodes end, but data has 5 steps"),
        ([[3, 5]], "needed one whole number per episode"),
    ):
        store_zarr(zarr.open_group(str(path), mode="a"), "meta/episode_ends", np.array(ends))
        with pytest.raises(ConfigError, match=message):
            load_demonstrations(path, **options)
    store_zarr(zarr.open_group(str(path), mode="a"), "meta/episode_ends", np.array([3.0, 5.0]))
    assert len(load_demonstrations(path, **options)) == 2
    (path / "meta/episode_ends/0").unlink()
    with pytest.raises(ConfigError, match=r"number 1 of 1, of meta/episode_ends is missing"):
        load_demonstrations(path, **options)


@needs_zarr_3
def test_a_missing_chunk_inside_a_shard_of_zarr_is_refused(tmp_path):
    path = foreign_zarr(tmp_path / "a.zarr", 3)
    options = {"shape": (5, 5), "dtype": "f8", "chunks": (4, 5), "overwrite": True}
    for location in ("start", "end"):
        codec = zarr.codecs.ShardingCodec(chunk_shape=(1, 5), index_location=location)
        data = zarr.open_group(str(path / "data"), mode="a")
        array = data.create_array("action", **options, serializer=codec, compressors=None)
        array[:] = 0.5
        assert len(load_demonstrations(path, task=TASK, env=ENV, mapping=ZARR)) == 2
        array[1] = 0  # zarr leaves it out
        message = r"inner chunk \(1, 0\), the first of 1, of the shard .* of data/action is missing"
        for mapped in (path, zipped(path)):
            with pytest.raises(ConfigError, match=message):
                check_demonstrations(mapped, task=TASK, env=ENV, mapping=ZARR)
    shard = path / "data/action/c/0/0"
    shard.write_bytes(shard.read_bytes()[:9])
    with pytest.raises(ConfigError, match="action: the shard data/action/c/0/0 is damaged"):
        check_demonstrations(path, task=TASK, env=ENV, mapping=ZARR)
    data.create_array("action", **options, serializer=codec, compressors=zarr.codecs.ZstdCodec())
    data["action"][:] = 0.5
    with pytest.raises(ConfigError, match="the codecs of its shards do not show"):
        check_demonstrations(path, task=TASK, env=ENV, mapping=ZARR)


def test_a_truncated_archive_is_damaged(tmp_path):
    archive = zipped(foreign_zarr(tmp_path / "a.zarr"))
    archive.write_bytes(archive.read_bytes()[:-100])
    for mapping in (ZARR, None):
        with pytest.raises(DamagedFilesError, match="a damaged zip archive: it has no end"):
            load_demonstrations(archive, task=TASK, env=ENV, mapping=mapping)


def test_a_header_of_zarr_of_many_rows_is_refused_quickly(tmp_path):
    path = foreign_zarr(tmp_path / "a.zarr")
    for name in ("data/action", "meta/episode_ends"):
        header = path / name / ".zarray"
        values = json.loads(header.read_text())
        values["shape"][0] = 10**12  # of each chunk, a name would need terabytes
        header.write_text(json.dumps(values))
        with pytest.raises(ConfigError, match=f"of 500000000000, of {name} is missing"):
            check_demonstrations(path, task=TASK, env=ENV, mapping=ZARR)


def test_an_instruction_that_was_not_observed_is_that_of_the_task(episodes, tmp_path):
    plain = [each.exclude("instruction", ("next", "instruction")) for each in episodes]
    card = read_card(exported(tmp_path, plain, "hdf5"))
    assert card.instructions == [card.prompt] == [ba_torchrl.describe(TASK).instruction]
    assert card.model_copy(update={"instructions": []}).prompt == card.goal


def test_only_folders_of_ours_are_read_for_an_export(tmp_path):
    for path in (foreign(tmp_path / "a.hdf5"), tmp_path):
        with pytest.raises(ConfigError, match="that `ba-torchrl collect` or `teleoperate` wrote"):
            read_demonstrations(path)


@pytest.mark.parametrize("lost", ["obs/depth", "actions"])
def test_rows_that_are_missing_are_named(lost, tmp_path):
    path = foreign(tmp_path / "a.hdf5")
    with h5py.File(path, "a") as file:
        rows = file[f"data/demo_1/{lost}"][:-1]
        del file[f"data/demo_1/{lost}"]
        file[f"data/demo_1/{lost}"] = rows[:0] if lost == "actions" else rows
    with pytest.raises(ConfigError, match=r"episode 1: .* rows, and there are [02] actions"):
        load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)
    with h5py.File(path, "a") as file:
        for name in ("obs/depth", "obs/state", "actions"):
            rows = file[f"data/demo_1/{name}"][:0]
            del file[f"data/demo_1/{name}"]
            file[f"data/demo_1/{name}"] = rows
    with pytest.raises(ConfigError, match="episode 1: there are no actions"):
        load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)
    with h5py.File(path, "a") as file:
        del file["data"]
        file.create_group("data")
    with pytest.raises(ConfigError, match="holds no episodes"):
        load_demonstrations(path, task=TASK, env=ENV, mapping=FOREIGN)


@pytest.mark.parametrize(
    ("name", "mapping", "message"),
    [
        ("a.hdf5", None, r"demonstrations_mapping\). It holds actions \[5\], obs"),
        ("ours", FOREIGN, "has our entries; leave out the mapping"),
        ("a.hdf5", "b.yaml", r"b\.yaml: must map keys to names"),
        ("a.hdf5", "d.yaml", r"d\.yaml: .* line 3"),
        ("none.hdf5", FOREIGN, "no demonstrations at .*in the formats"),
        ("c.hdf5", FOREIGN, r"c\.hdf5 cannot be read: OSError"),
    ],
)
def test_files_of_others_need_a_mapping_and_ours_need_none(
    name, mapping, message, collected, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    foreign("a.hdf5")
    Path("b.yaml").write_text("- a\n- b\n")
    Path("d.yaml").write_text("depth: [1,\naction: b\n")
    Path("c.hdf5").write_text("no HDF5")
    save_demonstrations("ours", collected, task=TASK, env=ENV, seed=0)
    with pytest.raises(ConfigError, match=message):
        load_demonstrations(name, task=TASK, env=ENV, mapping=mapping)


@pytest.mark.parametrize(
    "pickled",
    [
        {"dtype": "|O", "filters": [{"id": "pickle"}]},
        {"filters": [{"id": "pickle"}]},
        {"compressor": {"id": "pickle"}},
    ],
)
def test_pickles_in_zarr_are_refused(pickled, tmp_path):
    path = foreign_zarr(tmp_path / "a.zarr")
    array = {"shape": [5], "chunks": [5], "dtype": "<f4", "filters": None, "compressor": None}
    array |= {"fill_value": None, "order": "C", "zarr_format": 2, **pickled}
    (path / "data/note").mkdir()
    (path / "data/note/.zarray").write_text(json.dumps(array))
    (path / "data/note/0").write_bytes(pickle.dumps(Exploding()))
    options = {"task": TASK, "env": ENV}
    assert len(load_demonstrations(path, mapping=ZARR, **options)) == 2
    for read in (check_demonstrations, load_demonstrations):
        with pytest.raises(ConfigError, match=r"note is not opened|No Zarr data type"):
            read(path, mapping={**ZARR, "reward": "note"}, **options)


class Exploding:
    def __reduce__(self):
        return pytest.exit, ("a pickle was loaded",)


@pytest.mark.parametrize("name", ["hdf5", "zarr", "minari", "lerobot"])
def test_a_missing_package_is_named(name, collected, tmp_path, monkeypatch):
    for module in ("h5py", "zarr", "minari", "lerobot.datasets.lerobot_dataset"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingPackageError, match=f"pip install .*{FORMATS[name].package}"):
        exported(tmp_path, collected, name)


def test_a_format_from_outside_the_package(episodes, tmp_path, monkeypatch):
    class Npz(Format):
        """One archive of NumPy."""

        package = "numpy"

        def matches(self, path):
            return path.suffix == ".npz"

        def names(self, entries):
            return {key: key.upper() for key in entries}

        def write(self, path, episodes, card):
            flat = {f"{i} {k}": v for i, each in enumerate(episodes) for k, v in each.items()}
            np.savez(path, **flat)

        def read(self, path):
            found = {}
            for name, rows in np.load(path).items():
                found.setdefault(int(name.split()[0]), {})[name.split()[1]] = rows
            return list(found.values())

    monkeypatch.setattr(FORMATS, "_entries", {**FORMATS._entries})
    FORMATS.register("npz")(Npz())
    options = {"task": TASK, "env": ENV}
    export_demonstrations(tmp_path / "a.npz", episodes, format="npz", seed=0, **options)
    assert_equal(load_demonstrations(tmp_path / "a.npz", **options), episodes)
    with pytest.raises(UnknownNameError, match="Did you mean 'npz'"):
        export_demonstrations(tmp_path / "b", episodes, format="npy", seed=0, **options)
