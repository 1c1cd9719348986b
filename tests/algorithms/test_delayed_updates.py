"""An algorithm whose policy and target are updated less often than its critics, as in TD3."""

import torch

from tests.algorithms import tiny


def only(loss, names):
    """The terms of a loss whose names are given, as a stage."""
    return lambda batch: loss(batch).select(*names)


def flat(parameters):
    return torch.cat([each.detach().flatten() for each in parameters])


def test_a_learner_leaves_out_the_stage_of_its_policy(monkeypatch):
    learner = tiny.build("sac")
    learner.stages = [only(learner.loss, ["loss_qvalue"]), only(learner.loss, ["loss_actor"])]
    moves = learner.target_updater.step
    kind = type(learner)

    def is_due(self):
        return self.updates % 3 == 2

    monkeypatch.setattr(kind, "due_stages", lambda self: self.stages[: 1 + is_due(self)])
    learner.target_updater.step = lambda: moves() if is_due(learner) else None
    learner.extend(tiny.transitions(learner))
    changed = []
    for _ in range(6):
        parts = {
            "actor": learner.loss.actor_network_params,
            "critic": learner.loss.qvalue_network_params,
            "target": learner.loss.target_qvalue_network_params,
        }
        before = {name: flat(part.values(True, True)) for name, part in parts.items()}
        learner.update()
        after = {name: flat(part.values(True, True)) for name, part in parts.items()}
        changed.append({name for name in parts if not torch.equal(before[name], after[name])})
    assert changed == 2 * [{"critic"}, {"critic"}, {"actor", "critic", "target"}]


def test_first_updates_are_those_of_pretraining_whatever_stages_are_due(monkeypatch):
    learner = tiny.build("sac", init={"name": "bc", "updates": 1})
    monkeypatch.setattr(type(learner), "due_stages", lambda self: self.stages)
    learner.extend(tiny.transitions(learner))
    assert "loss_qvalue" not in learner.update()
    assert "loss_qvalue" in learner.update()
