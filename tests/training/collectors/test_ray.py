"""Collection on a Ray cluster, one of whose nodes fails."""

import time
from unittest.mock import Mock

import pytest
import torch

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.training import ray_cluster
from ba_torchrl.training.collectors import ray as collectors
from ba_torchrl.training.experiment import Experiment
from tests.training.collectors.runs import (
    change_weights,
    config_for,
    own_actions,
    start,
)
from tests.training.ray_nodes import ray_nodes

OPTIONS = {"name": "ray", "workers": 2}


def test_without_ray_one_line_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr("ba_torchrl.training.ray_cluster.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install .*ray") as raised:
        config_for(tmp_path, OPTIONS)
    assert "\n" not in str(raised.value)


def test_a_cluster_that_is_too_small_is_noticed_before_anything_starts(tmp_path, monkeypatch):
    module = Mock()
    module.cluster_resources.return_value = {"CPU": 1.0}
    monkeypatch.setattr(ray_cluster, "find_spec", Mock())
    monkeypatch.setattr(ray_cluster, "ray_module", lambda: module)
    config = config_for(tmp_path, OPTIONS)
    with pytest.raises(ConfigError, match="2 CPUs are needed, the Ray cluster has 1"):
        Experiment(config, progress=False)
    assert not (tmp_path / "run").exists()


def test_more_failures_than_max_restarts_end_the_collection(tmp_path, monkeypatch):
    """Ray counts the failures of each task; it raises the error of the actor in the end."""

    class RayActorError(Exception):
        pass

    def start_without_ray(self, *_, remote_configs, **__):
        assert remote_configs["max_task_retries"] == 3
        self._remote_collectors = [Mock(), Mock()]

    module = Mock(exceptions=Mock(RayActorError=RayActorError))
    module.cluster_resources.return_value = {"CPU": 2.0}
    monkeypatch.setattr(ray_cluster, "find_spec", Mock())
    monkeypatch.setattr(ray_cluster, "ray_module", lambda: module)
    monkeypatch.setattr(collectors, "ray_module", lambda: module)
    monkeypatch.setattr(collectors.RayCollector, "__init__", start_without_ray)
    monkeypatch.setattr(collectors.RayCollector, "iterator", lambda _: map(fail, [0]))
    fail = Mock(side_effect=RayActorError("the worker died"))
    collection, _ = start(config_for(tmp_path, OPTIONS, max_restarts=3))
    with pytest.raises(RuntimeError, match="failed 4 times in a row; the last time: the worker"):
        next(collection)


def nodes_of_workers(ray):
    """Return the ids of the nodes that run the workers."""
    from ray._private.state import actors

    return {actor["Address"]["NodeID"] for actor in actors().values() if actor["State"] == "ALIVE"}


@pytest.mark.slow
def test_collection_goes_on_when_a_node_fails(tmp_path):
    with ray_nodes(3) as (cluster, nodes, ray):
        collection, learner = start(config_for(tmp_path, OPTIONS))
        batches = [next(collection) for _ in range(6)]
        change_weights(learner, updates=5)
        batches += [next(collection) for _ in range(4)]  # two of each worker, or more of one
        newest = batches[-1]
        assert collection.scalars["lag"] == 0
        assert torch.allclose(newest[keys.ACTION], own_actions(learner, newest), atol=1e-6)
        data = torch.cat(batches)
        rows = torch.cat([data[keys.DEPTH].flatten(1), data[keys.ACTION]], dim=1)
        assert len(rows.unique(dim=0)) == len(rows) == 2 * len(batches)

        worker = collection._collector.remote_collectors[0]
        with pytest.raises(ray.exceptions.RayTaskError):  # not repeated, as failed nodes are
            ray.get(worker.cascade_execute.remote("policy.receive"), timeout=60)

        busy = nodes_of_workers(ray)
        assert len(busy) == 2
        failing = next(node for node in nodes if node.node_id in busy)
        cluster.remove_node(failing, allow_graceful=False)
        during, deadline = 0, time.monotonic() + 120
        while not collection.scalars["restarts"] and time.monotonic() < deadline:
            batch = next(collection)
            during += 1
            assert torch.allclose(batch[keys.ACTION], own_actions(learner, batch), atol=1e-6)
        assert collection.scalars == {"restarts": 1, "lag": 0.0}
        assert during > 1  # of the other worker
        assert failing.node_id not in nodes_of_workers(ray)
        assert len(nodes_of_workers(ray)) == 2
        collection.close()


@pytest.mark.slow
def test_a_run_on_a_cluster_ends_like_every_run(tmp_path):
    with ray_nodes(2):
        experiment = Experiment(config_for(tmp_path, OPTIONS), progress=False)
        result = experiment.run()
        assert result.updates == 12
        steps = experiment.state.env_steps
        assert 4 * 12 <= steps <= 4 * 12 + 4
        is_demonstration = experiment.learner.replay.storage.column("is_demonstration")
        assert len(experiment.learner.replay) == int(is_demonstration.sum()) + steps
        with pytest.raises(ConfigError, match="4 CPUs are needed, the Ray cluster has 2"):
            start(config_for(tmp_path, {**OPTIONS, "workers": 4}))
