"""The command line: names, mistakes, help, and what it is given to resume."""

import gc
import json
import signal
import subprocess
import sys

import pytest
from omegaconf import OmegaConf

from ba_torchrl import cli
from ba_torchrl.cli.command import Arguments
from ba_torchrl.commands import benchmark, train
from ba_torchrl.core.config import descriptions
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training.checkpoint import write_config
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.presets import preset
from tests.fresh import run_script
from tests.recipes import load_recipe
from tests.test_pages import unquoted
from tests.training.test_experiment import tiny


def refused(words, capsys):
    """The one line that a wrong command line prints."""
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    line = capsys.readouterr().err
    assert end.value.code == cli.EXIT_CODE, line
    assert line.startswith("error: ")
    assert line.count("\n") == 1
    return line


def test_the_overview_lists_every_command_with_its_first_line(capsys):
    cli.main([])
    out = capsys.readouterr().out
    for name in cli.command_names():
        first = load_recipe(name).__doc__.splitlines()[0]
        assert f"{name:11} {first}" in out


WITHOUT_TORCH = [
    *([name, "--help"] for name in cli.command_names()),
    ["train", "--config-name", "quickstart", "--help"],
    ["tran"],
    ["train", "network=cnnn"],
    ["train", "total_updates=many"],
    ["train", "algorithm.gama=1"],
    ["train", "network=equi", "--help"],
    ["train", "task=close_loop/block_pickng"],
    ["train", "env.obs_size=3"],
    ["benchmark", "jobs=0"],
    ["tasks"],
    *([name, "seed=a"] for name in ("collect", "evaluate", "experts", "export", "play", "speed")),
    *([name, "close_loop/block_picking", "env.scale=3"] for name in ("collect", "play", "speed")),
]
"""Command lines that are answered without the import of torch, which takes seconds."""


def test_help_and_mistakes_are_answered_without_torch():
    code = (
        "import sys\nfrom ba_torchrl import cli\n"
        f"for words in {WITHOUT_TORCH}:\n"
        "    try:\n        cli.main(words)\n    except SystemExit as end:\n"
        "        assert end.code == cli.EXIT_CODE, words\n"
        "    assert not {'torch', 'tensordict', 'torchrl'} & sys.modules.keys(), words\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_an_unknown_setting_is_answered_before_presets_are_composed(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ba_torchrl.training.presets", None)
    line = refused(["train", "network=cnnn", "seeed=1"], capsys)
    assert "unknown setting 'seeed'. Did you mean 'seed'?" in line
    assert gc.isenabled()  # which is off during imports


@pytest.mark.parametrize("words", [["train", "--help"], ["tasks"]])
def test_the_end_of_the_reader_ends_a_command_silently(words, tmp_path):
    code = (
        "import os\nreader, writer = os.pipe()\nos.close(reader)\nos.dup2(writer, 1)\n"
        f"from ba_torchrl import cli\ncli.main({words})\n"
    )
    done = run_script(tmp_path, code, check=False)
    assert done.returncode == 128 + signal.SIGPIPE
    assert "Broken" not in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "unknown command 'trian'. Did you mean 'train'?"),
        (["train", "--confg-name", "x"], "unknown option '--confg-name'. Did you mean '--config"),
        (["train", "--total_updates", "10"], "'--total_updates': write total_updates=10"),
        (["train", "--resume"], "write resume=VALUE"),
        (["benchmark", "network=cnn"], "network: benchmark takes a list of presets; write network"),
        (["benchmark", "--tasks=[a,b]"], "write 'tasks=[a,b]'"),
        (["train", "--multirun", "seed=1,2"], "unknown option '--multirun'. Known: --help, "),
        (["train", "--config-name", "quikstart"], "Did you mean 'quickstart'?"),
        (["train", "--config-name"], "expected one argument"),
        (["train", "--config-dir", "nowhere"], "there is no folder nowhere"),
        (["train", "env.scale=3"], "Did you mean 'object_scale_range' or 'view_scale'?"),
        (["train", "algorithm.optimizer.lerning_rate=1"], "Did you mean 'learning_rate'?"),
        (["train", "algorithm=dqn", "algorithm.magrin=1"], "unknown parameter 'magrin'. Known: "),
        (["train", "network=cnm"], "unknown network 'cnm'. Did you mean 'cnn'?"),
        (
            ["train", "task=close_loop/block_pickng"],
            "Did you mean 'close_loop/block_picking'? `ba-torchrl tasks` and",
        ),
        (["train", "env.workspace=[1,2"], "cannot read 'env.workspace=[1,2'"),
        (["train", "seed=&a [*a]"], "cannot read 'seed=&a [*a]': "),
        (["train", "env..obs_size=64"], "cannot read 'env..obs_size=64': a setting is written as"),
        (["play", "env.=64"], "cannot read 'env.=64': a setting is written as in env.obs_size=64"),
        (["train", ".env=64"], "cannot read '.env=64': a setting is written as in env.obs_size=64"),
        (["train", "..=64"], "cannot read '..=64': a setting is written as in env.obs_size=64"),
        (["train", "env.obs_size.x=3"], "obs_size: must be a whole number (got {'x': 3})"),
        (["train", "total_updates=1e4"], "a whole number (got 10000.0; write 10000)"),
        (["train", "obs_size=64"], "unknown setting 'obs_size'. Did you mean 'env.obs_size'?\n"),
        (["train", "learning_rate=1"], "Did you mean 'algorithm.optimizer.learning_rate'?\n"),
        (["train", "device=gpu"], "use device=cpu or device=auto; torch knows no device 'gpu'\n"),
        (["train", "device=mps"], "'mps' cannot compute here: "),
        (["train", "launcher=ray"], "launcher is no setting of this command"),
        (["train", "collector=multi_sync", "collector.workers=2"], "equally; set num_envs=6"),
        (["train", "env.object_scale_range=[2,1]"], "invalid env: object_scale_range must satisfy"),
        (["train", "algorithm.target_entropy=x"], "must be a number, or 'auto' (got 'x')"),
        (["train", "algorithm.replay.name=x"], "Known: uniform, prioritized, symmetric\n"),
        (["benchmark", "seeds=0"], "seeds: must be at least 1, or a list (got 0)"),
        (["benchmark", "seeds=[a]"], "seeds.0: must be a whole number (got 'a')\n"),
        (["train", "close_loop/block_picking"], "write task=close_loop/block_picking, see"),
        (["train", "sacfd"], "'sacfd' sets nothing; write algorithm=sacfd, see --help"),
        (["--helpp"], "unknown option '--helpp'. Did you mean '--help'?"),
        (["train", "algorithm.name=[sac]"], "unknown algorithm ['sac']"),
        (["train", "plugins.0=mine"], "plugins.0: plugins is a list, which is set as a whole"),
        (["train", "seed=010"], "seed: YAML does not read 010 as a decimal number; write it"),
        (["train", "env.workspace=[[1:30, 2]]"], "YAML does not read 1:30 as a decimal number"),
        (["train", "label=null"], "label: must be text (got None)"),
        (["train", "block_picking"], "'block_picking' sets nothing; write FIELD=VALUE"),
        (["evaluate"], "policy is missing: ba-torchrl evaluate POLICY; see --help"),
        (["evaluate", "a", "b"], "'b' is one word too many: policy is 'a'"),
        (["evaluate", "a", "policy=b"], "policy is given twice"),
        (["doctor", "now"], "doctor has no settings"),
        (["play", "close_loop/block_picking", "policy=traned"], "Did you mean 'trained'?"),
        (["play", "--config-name", "x"], "play has no configuration files"),
        (["speed", "networks=[equo]"], "unknown network 'equo'. Did you mean 'equi'?"),
    ],
)
def test_a_mistake_is_one_line_with_the_nearest_name(words, message, capsys):
    assert message in refused(words, capsys)


ODD = "a=b, c;é#(~)'"


@pytest.mark.parametrize(
    ("name", "words", "field", "found"),
    [
        ("report", [f"~/{ODD}"], "runs", [f"HOME/{ODD}"]),
        ("report", ["a=b"], "runs", ["a=b"]),
        ("leaderboard", ["runs=[~/a=b,a=b]"], "runs", ["HOME/a=b", "a=b"]),
        ("evaluate", [f"policy=~/{ODD}"], "policy", f"HOME/{ODD}"),
        ("convert", ["x/y=z", "format=zarr", "path=~/new=z"], "demos", "x/y=z"),
        ("convert", ["x/y=z", "format=zarr", "path=~/new=z"], "path", "HOME/new=z"),
        ("train", ["--config-name", "quickstart", f"run_dir=~/{ODD}"], "run_dir", f"HOME/{ODD}"),
        ("train", ["--config-dir=~/a=b", "run_dir=2024"], "run_dir", "2024"),
        ("train", ["label=~ a(b)=c"], "label", "~ a(b)=c"),  # no path
        ("benchmark", [f"folder=~/{ODD}"], "folder", f"HOME/{ODD}"),
    ],
)
def test_paths_may_have_any_sign_and_begin_in_the_home(
    name, words, field, found, tmp_path, monkeypatch
):
    """As shells pass them that leave ``~`` after "="."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for folder in (ODD, "a=b"):
        (tmp_path / folder).mkdir()
    command = load_recipe(name).COMMAND
    arguments = command.read(words)
    with command.composed(arguments) as settings:
        values = OmegaConf.to_container(settings)
    model = ExperimentConfig if name == "train" else command.settings
    own = {key: value for key, value in values.items() if key in model.model_fields}
    value = getattr(model.model_validate(own), field)
    assert json.loads(json.dumps(value).replace(str(tmp_path), "HOME")) == found


@pytest.mark.parametrize("name", [name for name in cli.command_names() if name != "doctor"])
def test_the_help_describes_every_setting(name, capsys):
    cli.main([name, "--help"])
    out = capsys.readouterr().out
    model = load_recipe(name).COMMAND.settings
    assert descriptions(model).keys() == model.model_fields.keys()
    for field in model.model_fields:
        assert f"\n  {field}" in out or f"\n  '{field}=" in out
    assert unquoted(out) == []


def test_the_help_shows_the_fields_of_the_chosen_presets_and_their_choices(capsys):
    cli.main(["--help", "train", "algorithm=dqn", "task=open_loop/bin_packing", "seeed=1"])
    out = capsys.readouterr().out
    assert "algorithm.epsilon_" in out
    assert "env.robot=kuka   {kuka, panda, ur5, ur5_robotiq}" in out
    assert "--config-name: quickstart | " in out
    assert "network=asr | cnn | " in out


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("hydra", "needs the extra [train] of the package, of which 'hydra-core' is missing: pip"),
        ("pybullet.x", "needs a package: 'pybullet' is missing: pip install "),
    ],
)
def test_a_package_that_is_missing_is_one_line(module, words, monkeypatch, capsys):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    monkeypatch.setattr(cli.importlib, "import_module", missing)
    assert words in refused(["train"], capsys)


def test_the_folder_alone_resumes_a_run(tmp_path, caplog):
    config = tiny(tmp_path, total_updates=7)
    write_config(config)
    values = ExperimentConfig.parse(
        {**config.model_dump(), "total_updates": 99, "resume": True, "threads": 1}
    ).model_dump()
    given = Arguments({"run_dir": config.run_dir, "resume": True, "threads": 1})
    found = train.parse(values, given)
    assert (found.total_updates, found.resume, found.threads) == (7, True, 1)
    everything = Arguments({**given.given, "total_updates": 99})
    assert train.parse(values, everything).total_updates == 99
    assert caplog.text == ""
    (tmp_path / "other").mkdir()
    new = {**values, "run_dir": str(tmp_path / "other")}
    with pytest.raises(ConfigError, match=rf"^there is no run in {new['run_dir']} to resume$"):
        train.parse(new, given)
    with pytest.raises(ConfigError, match="needs run_dir=FOLDER"):
        train.parse(values, Arguments({"resume": True}))
    assert train.parse(new, everything).total_updates == 99
    assert f"there is no run in {new['run_dir']} to resume: a new one starts" in caplog.text


def test_an_own_configuration_in_a_further_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("defaults: [train, _self_]\nseed: 7\n")
    cli.main(["train", "--config-dir", ".", "--config-name", "mine", "--help"])
    assert "  seed=7" in capsys.readouterr().out
    (tmp_path / "my_grid.yaml").write_text("defaults: [benchmark, _self_]\nseeds: 9\n")
    cli.main(["benchmark", "--config-dir", ".", "--config-name", "my_grid", "--help"])
    out = capsys.readouterr().out
    assert "  seeds=9" in out
    assert "launcher=local | ray" in out
    words = ["--config-dir", ".", "--config-name", "my_grid"]
    with benchmark.COMMAND.composed(benchmark.COMMAND.read(words)):
        assert preset("network", "cnn")["name"] == "cnn"
    (tmp_path / "my_grid.yaml").write_text("defaults: [benchmark, _self_]\nsedes: 9\n")
    line = refused(["benchmark", *words], capsys)
    assert "unknown setting 'sedes'. Did you mean 'seeds'" in line


def test_an_interruption_while_a_command_is_imported_is_one_line(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.importlib, "import_module", interrupted)
    with pytest.raises(SystemExit) as end:
        cli.main(["train"])
    assert end.value.code == 128 + signal.SIGINT
    assert capsys.readouterr().err == "stopped by SIGINT\n"


def test_streams_that_are_closed_take_nothing(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    cli.main(["--version"])


def test_a_working_directory_that_was_deleted_is_one_line(tmp_path, monkeypatch, capsys):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert refused(["tasks"], capsys) == "error: the working directory was deleted\n"


def test_errors_of_a_run_are_not_hidden(tmp_path, monkeypatch):
    def broken(_):
        raise ZeroDivisionError

    monkeypatch.setattr("ba_torchrl.training.experiment.Experiment", broken)
    with pytest.raises(ZeroDivisionError):
        train.main(tiny(tmp_path))


def test_doctor_names_the_command_that_mends(capsys, monkeypatch):
    from ba_torchrl.commands import doctor

    monkeypatch.setattr(doctor, "OPTIONAL", ())
    monkeypatch.setattr(doctor, "NEEDED", ("torch", "no-such-package"))
    with pytest.raises(SystemExit) as end:
        doctor.COMMAND.run([])
    out = capsys.readouterr().out
    assert end.value.code == 1
    assert "no-such-package        missing\n" in out
    assert "pip install no-such-package" in out
    assert "trained policies       bump/house_building_4, close_loop/block_in_bowl" in out


def test_doctor_goes_on_without_a_package_and_with_a_damaged_one(capsys, monkeypatch):
    from ba_torchrl.commands import doctor

    def damaged():
        raise OSError("libcudart.so: cannot open\nshared object file")

    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setitem(doctor.CHECKS, "cpu", damaged)
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "torch" else "1")
    with pytest.raises(SystemExit) as end:
        doctor.COMMAND.run([])
    out = capsys.readouterr().out
    assert end.value.code == 1
    assert "torch                  missing\n" in out
    assert "cpu                    not known: libcudart.so: cannot open shared object file\n" in out
    assert "gpu                    not known without torch\n" in out
    assert "shared memory          " in out


@pytest.mark.slow
def test_speed_prints_rates(capsys, monkeypatch):
    words = ["close_loop/block_reaching", "env.obs_size=64", "steps=4", "num_envs=2", "updates=1"]
    monkeypatch.setattr("ba_torchrl.commands.speed.WARM_UP_UPDATES", 0)
    cli.main(["speed", *words, "networks=[cnn]"])
    rows = [line for line in capsys.readouterr().out.splitlines() if "block_reaching" in line]
    assert len(rows) == 4
    assert all(float(row.split(" steps")[0].split()[-1]) > 0 for row in rows[:3])
    assert "updates" in rows[3]


def test_tasks_are_listed_described_and_written(tmp_path, capsys):
    cli.main(["tasks"])
    assert "  close_loop/block_picking           the block is held" in capsys.readouterr().out
    cli.main(["tasks", "close_loop/block_picking"])
    assert "expert:             kuka 1.000 in 7.0 steps" in capsys.readouterr().out
    page = tmp_path / "it's a pagé.md"
    cli.main(["tasks", "close_loop/block_picking", f"path={page}"])
    assert "### `close_loop/block_picking`" in page.read_text()
