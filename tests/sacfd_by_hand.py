"""The terms of the SACfD loss in plain Python, for the networks of `tests.linear_sac`."""

import math

from ba_torchrl.envs import keys


def affine(row_weights, bias, x):
    return [
        sum(w * v for w, v in zip(row, x, strict=True)) + b
        for row, b in zip(row_weights, bias, strict=True)
    ]


def importance(data, terms, norm):
    """Weights of the critic's, the policy's and the other terms of each sample."""
    ones = [1.0] * len(data)
    weights = data["priority_weight"].tolist() if "priority_weight" in data else ones
    divisor = max(weights) if norm == "max" else sum(weights) / len(weights)
    weights = [w / divisor for w in weights]
    number = ["none", "critic", "critic_and_policy", "all"].index(terms)
    return [weights if number >= least else ones for least in (1, 2, 3)]


def by_hand(
    loss,
    data,
    gamma,
    alpha,
    target_entropy,
    demonstration_weight,
    terms="critic_and_policy",
    norm="max",
    entropy_backup=True,
    imitated_scale=1.0,
):
    """The terms of the loss, computed with Python floats and loops."""

    def parameters(name):
        tree = getattr(loss, name)
        return tree["module", "net", "weight"].tolist(), tree["module", "net", "bias"].tolist()

    actor_tree = loss.actor_network_params["module", "0", "module"]
    actor = actor_tree["net", "weight"].tolist(), actor_tree["net", "bias"].tolist()
    log_std = actor_tree["log_std"].tolist()

    def policy(x):
        action = [math.tanh(v) for v in affine(*actor, x)]
        return action, (sum(action) + sum(log_std)) / 2

    def q(x, action, prefix):
        encoder = parameters(f"{prefix}encoder_network_params")
        features = [math.tanh(v) for v in affine(*encoder, x)]
        return affine(*parameters(f"{prefix}qvalue_network_params"), features + action)

    def observation(tree, i):
        return [*tree[keys.PIXELS][i].tolist(), float(tree[keys.HOLDING][i])]

    n = len(data)
    critic, policy_weights, others = importance(data, terms, norm)
    qvalue = actor_term = alpha_term = entropy = value = behaviour = weighted_behaviour = 0.0
    experts, priorities = 0, []
    for i in range(n):
        x, following = observation(data, i), observation(data[keys.NEXT], i)
        stored = data[keys.ACTION][i].tolist()
        next_action, next_log_prob = policy(following)
        bootstrap = min(q(following, next_action, "target_"))
        bootstrap -= alpha * next_log_prob * entropy_backup
        y = float(data[keys.NEXT, keys.REWARD][i])
        if not data[keys.NEXT, keys.TERMINATED][i]:
            y += gamma * bootstrap
        errors = [v - y for v in q(x, stored, "")]
        qvalue += critic[i] * sum(e * e for e in errors) / n
        value += sum(q(x, stored, "")) / 2 / n
        priorities.append([sum(abs(e) for e in errors) / 2])
        action, log_prob = policy(x)
        actor_term += policy_weights[i] * (alpha * log_prob - min(q(x, action, ""))) / n
        alpha_term -= others[i] * math.log(alpha) * (log_prob + target_entropy) / n
        entropy -= log_prob / n
        if keys.IS_EXPERT in data and data[keys.IS_EXPERT][i]:
            experts += 1
            imitated = [imitated_scale * a for a in action]
            error = sum((a - e) ** 2 for a, e in zip(imitated, stored, strict=True)) / 2
            behaviour += error
            weighted_behaviour += others[i] * error
    behaviour /= max(experts, 1)
    weighted_behaviour /= max(experts, 1)
    return {
        "loss_qvalue": qvalue,
        "loss_actor": actor_term + demonstration_weight * weighted_behaviour,
        "loss_alpha": alpha_term,
        "alpha": alpha,
        "entropy": entropy,
        "demonstration_error": behaviour,
        "q_value": value,
    }, priorities
