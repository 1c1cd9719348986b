"""A Ray cluster of several nodes on this machine, whose nodes can fail."""

import contextlib
import os

import pytest

MB = 2**20
NICENESS = "RAY_worker_niceness"


@contextlib.contextmanager
def ray_nodes(count, cpus=1):
    """Start a cluster and connect to it; yield the cluster, its nodes and the module `ray`."""
    pytest.importorskip("ray", reason="Ray is an optional package: pip install ray")
    os.environ[NICENESS] = "0"  # workers are not slower than the processes of other tests
    import ray
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False, "object_store_memory": 200 * MB}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        limits = {"num_cpus": cpus, "object_store_memory": 100 * MB}
        nodes = [cluster.add_node(**limits) for _ in range(count)]
        ray.init(address=cluster.address, log_to_driver=False)
        yield cluster, nodes, ray
    finally:
        ray.shutdown()
        cluster.shutdown()
