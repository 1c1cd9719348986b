import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from ba_torchrl.core import keys
from ba_torchrl.core.actions import OpenLoopActions
from ba_torchrl.data.augmentation.rigid import (
    RigidAugmentation,
    RigidTransform,
    transform_images,
)
from ba_torchrl.sim.vision.in_hand import IN_HAND_MODES, PickView
from tests.specs import from_replay, open_loop_images

BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
SIZE = 32
STEP_M = 0.4 / SIZE


def layout(sequence="pxyr", half_rotation=True):
    return OpenLoopActions(sequence, BOUNDS, half_rotation)


def augmentation(transforms, actions, channels=1, seed=0, **settings):
    return RigidAugmentation(
        transforms, actions, open_loop_images(channels=channels), seed=seed, **settings
    )


def reverse_in_hand(image, axes):
    return open_loop_images(channels=image.shape[1])["in_hand"].reverse_axes(image, axes)


def spot(x, y):
    """A heightmap with a smooth bump at a position, metres."""
    rows = 0.25 + (torch.arange(SIZE) + 0.5) * STEP_M
    columns = -0.2 + (torch.arange(SIZE) + 0.5) * STEP_M
    squared = (rows[:, None] - x) ** 2 + (columns[None] - y) ** 2
    return torch.exp(-squared / (2 * 0.03**2))[None]


def centre_of(image):
    """Position of the bump in a heightmap, metres."""
    rows = 0.25 + (torch.arange(SIZE) + 0.5) * STEP_M
    columns = -0.2 + (torch.arange(SIZE) + 0.5) * STEP_M
    weight = image[0] / image.sum()
    return (weight.sum(1) * rows).sum(), (weight.sum(0) * columns).sum()


def batch(places, yaws=None, sequence="pxyr"):
    count = len(places)
    heightmap = torch.stack([spot(x, y) for x, y in places])
    columns = {
        "p": torch.zeros(count),
        "x": torch.tensor([x for x, _ in places]),
        "y": torch.tensor([y for _, y in places]),
        "r": torch.tensor(yaws or [0.0] * count),
    }
    in_hand = torch.arange(16.0).reshape(1, 1, 4, 4).repeat(count, 1, 1, 1)
    return TensorDict(
        {
            "heightmap": heightmap,
            "in_hand": in_hand,
            "action": torch.stack([columns[letter] for letter in sequence], dim=1),
            "next": {"heightmap": heightmap.clone(), "in_hand": in_hand.clone()},
        },
        batch_size=[count],
    )


def transform(mirrored=False, angle=0.0, shift=(0.0, 0.0)):
    return RigidTransform(
        torch.tensor([mirrored]),
        torch.tensor([angle], dtype=torch.float64),
        torch.tensor([shift], dtype=torch.float64),
    )


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("k", range(4))
def test_quarter_turns_and_mirror_images_are_exact(k, mirrored):
    image = torch.rand(1, 2, SIZE, SIZE)
    expected = torch.rot90(image.flip(-1) if mirrored else image, k, (-2, -1))
    assert torch.equal(transform_images(image, transform(mirrored, k * math.pi / 2)), expected)


def test_a_shift_by_whole_pixels_moves_rows_along_x():
    image = torch.rand(1, 1, SIZE, SIZE)
    moved = transform_images(image, transform(shift=(3 / SIZE, -2 / SIZE)))
    expected = torch.zeros_like(image)
    expected[..., 3:, :-2] = image[..., :-3, 2:]
    torch.testing.assert_close(moved, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("transforms", "settings"),
    [("translation", {}), ("cn", {"order": 12}), ("d4", {}), ("se2", {})],
)
def test_the_action_follows_its_target_in_the_image(transforms, settings):
    places = [(0.45 + 0.01 * i, -0.06 + 0.012 * i) for i in range(10)] * 6
    data = batch(places)
    out = from_replay(augmentation(transforms, layout(), seed=0, **settings), data)
    assert not torch.allclose(out["action"], data["action"])
    for image, following, action in zip(
        out["heightmap"], out["next", "heightmap"], out["action"], strict=True
    ):
        assert torch.equal(image, following)
        x, y = centre_of(image)
        assert abs(x - action[1]) < 1e-3
        assert abs(y - action[2]) < 1e-3
    assert torch.equal(out["heightmap"], out["next", "heightmap"])  # were equal, and moved alike
    assert torch.equal(data["action"], batch(places)["action"])  # the input stays


def bar(yaw):
    """A heightmap of a bar through the centre, along a direction in the xy plane."""
    grid = (torch.arange(SIZE) - SIZE / 2 + 0.5) * STEP_M
    x, y = grid[:, None], grid[None]
    across = -math.sin(yaw) * x + math.cos(yaw) * y
    along = math.cos(yaw) * x + math.sin(yaw) * y
    return torch.exp(-((across / 0.02) ** 2) - (along / 0.08) ** 2)[None]


def direction_of(image):
    """The bar's direction in [0, pi), by its second moments."""
    grid = (torch.arange(SIZE) - SIZE / 2 + 0.5) * STEP_M
    weight = image[0] / image.sum()
    x, y = grid[:, None], grid[None]
    xx, yy, xy = ((weight * v).sum() for v in (x * x, y * y, x * y))
    return float(0.5 * torch.atan2(2 * xy, xx - yy)) % math.pi


@pytest.mark.parametrize("transforms", ["cn", "d4", "se2"])
def test_the_yaw_rotates_with_the_scene(transforms):
    yaws = [0.1 + 0.28 * i for i in range(11)] * 5
    data = batch([(0.45, 0.0)] * len(yaws), yaws)
    data["heightmap"] = torch.stack([bar(yaw) for yaw in yaws])
    out = augmentation(transforms, layout(), seed=1, order=8)(data)
    for image, yaw in zip(out["heightmap"], out["action"][:, 3].tolist(), strict=True):
        assert 0 <= yaw <= math.pi + 1e-6
        if transforms != "se2":  # shifted bars are not about the middle
            off = (direction_of(image) - yaw + math.pi / 2) % math.pi - math.pi / 2
            assert abs(off) < 0.02
    assert len(out["action"][:, 3].unique()) > 20


def test_yaws_span_a_full_turn_without_half_rotation():
    data = batch([(0.45, 0.0)] * 400, [0.2] * 400)
    out = augmentation("cn", layout(half_rotation=False), seed=0, order=4)(data)
    found = sorted({round(float(yaw), 4) for yaw in out["action"][:, 3]})
    assert found == pytest.approx([0.2 + k * math.pi / 2 for k in range(4)], abs=1e-4)


def test_tilts_change_sign_when_the_yaw_wraps():
    actions = layout("pxyrrr")
    data = batch([(0.45, 0.0)] * 200)
    # components: p x y rz ry rx
    extra = torch.tensor([[0.3, 0.2, -0.1]]).expand(200, 3)
    data["action"] = torch.cat([data["action"][:, :3], extra], dim=1)
    out = augmentation("cn", actions, seed=0, order=4)(data)["action"]
    # 0.3 + pi and 0.3 + 3 pi / 2 come back by half a turn of the gripper about its axis
    expected = {
        (round(yaw, 3), sign * 0.2, -sign * 0.1)
        for yaw in (0.3, 0.3 + math.pi / 2)
        for sign in (1, -1)
    }
    assert {tuple(round(value, 3) for value in row) for row in out[:, 3:].tolist()} == expected
    signs = out[:, 4] > 0
    assert 0.3 < signs.float().mean() < 0.7


def view(turn, mirrored=False):
    """A pick at a yaw of 0.3 of an asymmetric object in a scene that is reflected, then rotated."""
    heights = np.zeros((65, 65))
    heights[30:42, 29:34], heights[31:34, 33:48], heights[37:40, 31:33] = 0.03, 0.05, 0.07
    yaw = -0.3 if mirrored else 0.3
    heights = np.rot90(np.fliplr(heights) if mirrored else heights, turn)
    return heights.copy(), yaw + turn * math.pi / 2


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize(("mode", "share"), [("raw", 1e-6), ("sub", 1e-6), ("proj", 0.12)])
def test_the_in_hand_image_equals_that_of_the_transformed_scene(mode, share, turn, mirrored):
    def seen(turn, mirrored=False, over=False):
        heights, yaw = view(turn, mirrored)
        yaw = yaw % math.pi if over else yaw
        picked = PickView(heights, np.zeros_like(heights), (32.5, 32.5), 0.006, 0.03, yaw)
        return torch.from_numpy(IN_HAND_MODES[mode]().draw(picked, 24).copy())[None].float()

    image, wanted = seen(0), seen(turn, mirrored, over=True)
    yaw = view(turn, mirrored)[1] % (2 * math.pi)
    if mirrored:
        image = reverse_in_hand(image, "y")
    if yaw > math.pi:
        image = reverse_in_hand(image, "xy")
    error, before = ((one - wanted).abs().mean() / wanted.abs().mean() for one in (image, seen(0)))
    assert error < share
    if mirrored or yaw > math.pi:  # and without it would not have been
        assert error < 0.7 * before


@pytest.mark.parametrize("channels", [1, 3])
def test_the_in_hand_image_follows_the_gripper(channels):
    data = batch([(0.45, 0.0)] * 60, [0.3] * 60)
    image = torch.arange(channels * 16.0).reshape(1, channels, 4, 4)
    for key in ("in_hand", ("next", "in_hand")):
        data[key] = image.repeat(60, 1, 1, 1)
    over, mirror = reverse_in_hand(image, "xy"), reverse_in_hand(image, "y")
    turned = augmentation("cn", layout(), channels, order=4)(data)
    for first, second, action in zip(
        turned["in_hand"], turned["next", "in_hand"], turned["action"], strict=True
    ):
        # 0.3 and 0.3 + pi / 2 are reached directly or by half a turn more, which turns it over
        assert torch.equal(first, second)
        assert torch.equal(first, image[0]) or torch.equal(first, over[0])
        assert 0 <= action[3] <= math.pi
    is_over = [torch.equal(one, over[0]) for one in turned["in_hand"]]
    assert 18 < sum(is_over) < 42
    mirrored = augmentation("d4", layout(), channels)(data)
    kinds = [image, mirror, over, reverse_in_hand(mirror, "xy")]
    counts = [sum(torch.equal(one, kind[0]) for one in mirrored["in_hand"]) for kind in kinds]
    assert sum(counts) == 60
    assert min(counts) > 5


def test_the_in_hand_image_is_unchanged_without_half_rotation():
    data = batch([(0.45, 0.0)] * 20)
    turned = augmentation("cn", layout(half_rotation=False), seed=0)(data)
    assert torch.equal(turned["in_hand"], data["in_hand"])


def test_actions_stay_within_the_workspace():
    places = [(0.26, -0.19), (0.64, 0.19)] * 100
    out = augmentation("se2", layout(), seed=0)(batch(places))
    assert (out["action"][:, 1] >= 0.25).all()
    assert (out["action"][:, 1] <= 0.65).all()
    assert (out["action"][:, 2].abs() <= 0.2).all()


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_the_fraction_of_transformed_transitions(probability):
    data = batch([(0.45, 0.05)] * 600)
    module = RigidAugmentation(
        "translation", layout(), open_loop_images(), seed=0, probability=probability
    )
    moved = (module(data)["action"] != data["action"]).any(dim=1).float().mean()
    assert abs(float(moved) - probability) < 0.06


def test_the_seed_and_a_saved_state_determine_the_draws():
    data = batch([(0.45, 0.05)] * 5)
    first, second = (augmentation("se2", layout(), seed=3) for _ in range(2))
    assert torch.equal(first(data)["action"], second(data)["action"])
    first(data)
    second.load_state_dict(first.state_dict())
    assert torch.equal(first(data)["action"], second(data)["action"])


def test_another_action_is_transformed_alone():
    data = batch([(0.45, 0.05)] * 5)
    expected = augmentation("se2", layout(), seed=0)(data)
    data["target_action"], data["action"] = data["action"].clone(), torch.zeros_like(data["action"])
    out = augmentation("se2", layout(), seed=0, action_key=keys.TARGET_ACTION)(data)
    assert torch.equal(out["target_action"], expected["action"])
    assert torch.equal(out["heightmap"], expected["heightmap"])
    assert "action" not in out


@pytest.mark.parametrize("holding", [False, True])
@pytest.mark.parametrize("transforms", ["d4", "se2"])
def test_every_equal_move_is_transformed_as_the_action_is(transforms, holding):
    count, places = 40, [(0.45, -0.05), (0.45, 0.05), (0.26, -0.19)]
    yaws = [0.3, 0.3 + math.pi / 2, 1.0]
    data, moves = batch(places[:1] * count, [0.3] * count), batch(places, yaws)["action"]
    data["target_moves"] = moves.expand(count, 3, -1)
    data["holding"] = torch.full((count, 1), holding)
    out = augmentation(transforms, layout())(data)
    torch.testing.assert_close(out["target_moves"][:, 0], out["action"])
    lost = 0
    for j in (1, 2):
        # where the first move went says how the scene moved
        for first, move, image in zip(
            out["action"], out["target_moves"][:, j], out["in_hand"], strict=True
        ):
            seen = [reverse_in_hand(data["in_hand"][:1], axes)[0] for axes in ("", "xy", "y", "x")]
            is_mirrored = [torch.equal(image, each) for each in seen].index(True) >= 2
            sign = -1 if is_mirrored else 1
            is_over = torch.equal(image, seen[1]) or torch.equal(image, seen[3])
            angle = float(first[3]) - sign * yaws[0] + math.pi * is_over
            turned = sign * yaws[j] + angle
            wraps = bool(math.floor(turned / math.pi) % 2) != is_over
            start, end = (torch.tensor(place) for place in (places[0], places[j]))
            dx, dy = (end - start).tolist()
            dy *= sign
            x = float(first[1]) + math.cos(angle) * dx - math.sin(angle) * dy
            y = float(first[2]) + math.sin(angle) * dx + math.cos(angle) * dy
            leaves = not (0.25 <= x <= 0.65 and -0.2 <= y <= 0.2)
            if leaves or (holding and wraps):
                lost += 1
                assert torch.equal(move, first)
            else:
                expected = torch.tensor([0.0, x, y, turned % math.pi])
                torch.testing.assert_close(move, expected, atol=1e-5, rtol=0)
    assert (0 < lost < 2 * count) == (holding or transforms == "se2")


def test_transforms_that_the_action_cannot_follow_are_refused():
    with pytest.raises(ValueError, match="no yaw to rotate with it; use 'translation'"):
        augmentation("se2", layout("pxy"), seed=0)
    with pytest.raises(ValueError, match="tilts do not follow"):
        augmentation("d4", layout("pxyzrrr"), seed=0)
    with pytest.raises(ValueError, match="probability"):
        augmentation("cn", layout(), seed=0, probability=2.0)
    assert augmentation("translation", layout("pxy"), seed=0) is not None
