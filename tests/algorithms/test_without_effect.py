"""Values that have no effect together with others give a warning at the start of a run."""

import logging

from tests.algorithms.tiny import FERM, make_experiment


def test_a_run_starts_with_the_warnings(tmp_path, caplog):
    algorithm = {"name": "sac", **FERM}
    settings = {"demonstrations": 0, "demonstrations_noise": 0.2}
    made = make_experiment(tmp_path, "cnn", algorithm, **settings)
    with caplog.at_level(logging.WARNING):
        made.run()
    assert "contrastive has no effect on the encoder of the policy of 'cnn'" in caplog.text
    assert "demonstrations_noise has no effect with demonstrations=0" in caplog.text
