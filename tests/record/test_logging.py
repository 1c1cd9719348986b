import errno
from pathlib import Path

import numpy as np
import pytest
import torch

from ba_torchrl.record.logging import ScalarLog, progress_bar, read_scalars


class FakeLogger:
    def __init__(self):
        self.scalars, self.hparams, self.closed = [], None, 0

    def log_hparams(self, config):
        self.hparams = config

    def log_scalar(self, name, value, step):
        self.scalars.append((step, name, value))

    def close(self):
        self.closed += 1


@pytest.fixture
def fake_backend(monkeypatch):
    """Replace TorchRL's logger; return the fake one and the arguments it was made with."""
    logger, calls = FakeLogger(), []
    monkeypatch.setattr(
        "torchrl.record.loggers.get_logger",
        lambda *args, **kwargs: calls.append((args, kwargs)) or logger,
    )
    return logger, calls


class TestScalarLog:
    def test_has_one_row_per_scalar_and_survives_a_kill(self, tmp_path):
        log = ScalarLog(tmp_path / "run")
        log.write(0, {"eval/success_rate": 0.25})
        log.write(50, {"train/loss": torch.tensor([1 / 3]), "eval/success_rate": 1})
        # Not closed: a killed run closes nothing.
        assert (tmp_path / "run" / "scalars.csv").read_text().splitlines() == [
            "step,name,value",
            "0,eval/success_rate,0.25",
            f"50,train/loss,{torch.tensor(1 / 3).item()!r}",
            "50,eval/success_rate,1.0",
        ]
        scalars = read_scalars(tmp_path / "run")
        assert list(scalars) == ["eval/success_rate", "train/loss"]
        assert scalars["eval/success_rate"].steps.tolist() == [0, 50]
        assert scalars["eval/success_rate"].values.tolist() == [0.25, 1.0]
        log.close()
        log.close()

    def test_an_incomplete_row_is_cut_off_and_no_other_is_written_anew(self, tmp_path, monkeypatch):
        path = tmp_path / "scalars.csv"
        path.write_text("step,name,value\n1,a,0.5\n2,a,0")

        def full_disk(*_):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(Path, "write_bytes", full_disk)
        ScalarLog(tmp_path).close()
        assert path.read_text() == "step,name,value\n1,a,0.5\n"

    def test_resumes_after_an_incomplete_row(self, tmp_path):
        log = ScalarLog(tmp_path)
        for step in (1, 2, 3):
            log.write(step, {"a,b": step / 10})
        log.close()
        with log.path.open("a") as file:
            file.write("4,a")
        assert read_scalars(tmp_path)["a,b"].steps.tolist() == [1, 2, 3]
        log = ScalarLog(tmp_path)
        log.write(3, {"a,b": 7.0})
        log.write(4, {"a,b": float("nan")})
        log.close()
        steps, values = read_scalars(log.path)["a,b"]
        assert steps.tolist() == [1, 2, 3, 4]
        np.testing.assert_array_equal(values, [0.1, 0.2, 7.0, np.nan])

    def test_passes_scalars_on(self, tmp_path, fake_backend):
        logger, calls = fake_backend
        config = {"seed": 1, "env": {"robot": "kuka", "workspace": None}}
        log = ScalarLog(tmp_path / "run", "wandb", config)
        log.write(3, {"loss": torch.tensor(0.5)})
        log.close()
        log.close()
        assert logger.scalars == [(3, "loss", 0.5)]
        assert logger.closed == 1
        assert logger.hparams == {"seed": 1, "env.robot": "kuka", "env.workspace": "None"}
        (args, options) = calls[0]
        assert args == ("wandb",)
        assert options["logger_name"] == str(tmp_path / "run")
        assert options["experiment_name"] == "run"
        assert read_scalars(tmp_path / "run")["loss"].values.tolist() == [0.5]

    def test_tensorboard_writes_scalars(self, tmp_path):
        pytest.importorskip("tensorboard")
        log = ScalarLog(tmp_path, "tensorboard", {"seed": 0, "env": {"robot": "kuka"}})
        log.write(1, {"loss": 0.5})
        log.close()
        assert list(tmp_path.rglob("events.out.tfevents.*"))


class TestReadScalars:
    def test_other_files_are_refused(self, tmp_path):
        path = tmp_path / "scalars.csv"
        with pytest.raises(FileNotFoundError):
            read_scalars(path)
        path.write_text("a,b\n1,2\n")
        with pytest.raises(ValueError, match="does not start with the columns step, name, value"):
            read_scalars(path)
        path.write_text("step,name,value\n1,loss,high\n")
        with pytest.raises(ValueError, match="line 2"):
            read_scalars(path)

    def test_a_run_without_scalars(self, tmp_path):
        ScalarLog(tmp_path).close()
        assert read_scalars(tmp_path) == {}


def test_a_progress_bar_in_a_file_is_updated_rarely(capsys):
    with progress_bar(total=1000, unit="step") as bar:
        for _ in range(1000):
            bar.update()
    written = capsys.readouterr().err
    assert "1000/1000" in written
    assert written.count("\r") < 5
