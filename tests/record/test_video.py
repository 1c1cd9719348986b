import subprocess

import numpy as np
import pytest

from ba_torchrl.record.video import write_video

imageio = pytest.importorskip("imageio.v3")


def record_episodes(frames, height, width):
    """A bright square moves to the right over a dark background."""
    video = np.full((frames, height, width, 3), 30, dtype=np.uint8)
    for t in range(frames):
        video[t, 8:24, 4 * t : 4 * t + 16] = (250, 120, 40)
    return video


@pytest.mark.parametrize(
    ("height", "width", "written"), [(64, 96, (64, 96)), (61, 75, (62, 76)), (360, 480, (360, 480))]
)
def test_mp4_shows_the_frames(tmp_path, height, width, written):
    video = record_episodes(7, height, width)
    path = write_video(tmp_path / "new" / "episode.mp4", list(video), fps=5)
    read = imageio.imread(path, plugin="FFMPEG")
    assert read.shape == (7, *written, 3)
    assert imageio.immeta(path, plugin="FFMPEG")["fps"] == 5
    assert np.abs(read[:, :height, :width].astype(int) - video).mean() < 6


@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
def test_a_process_that_is_killed_leaves_no_file(tmp_path, monkeypatch, name):
    encode = subprocess.run

    def killed(*words, **options):
        assert encode(*words, **options).returncode == 0
        seen.append([*tmp_path.iterdir()])
        raise KeyboardInterrupt

    seen = []
    monkeypatch.setattr(subprocess, "run", killed)
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / name, record_episodes(2, 64, 96), fps=5)
    assert seen == [[]]


def test_gif_shows_the_frames(tmp_path):
    video = record_episodes(5, 33, 41)
    path = write_video(tmp_path / "episode.GIF", video, fps=4)
    read = imageio.imread(path, index=None)
    assert np.abs(read[..., :3].astype(int) - video).max() < 16
    assert imageio.immeta(path)["duration"] == 250
    assert imageio.immeta(path)["loop"] == 0


def test_a_gif_has_few_colours_that_are_the_same_in_all_frames(tmp_path):
    ramp = np.linspace(0, 255, 64 * 64).reshape(64, 64)
    video = [
        np.stack([np.roll(ramp, 9 * t, 1), ramp.T, 255 - ramp], -1).astype(np.uint8)
        for t in range(4)
    ]
    read = imageio.imread(write_video(tmp_path / "episode.gif", video, fps=4), index=None)
    assert len(np.unique(read[..., :3].reshape(-1, 3), axis=0)) <= 128
    assert np.abs(read[..., :3].astype(int) - video).mean() < 12


def test_a_gif_keeps_the_colour_of_an_object_in_a_single_frame(tmp_path):
    ramp = np.linspace(0, 255, 64 * 64).reshape(64, 64)
    video = [np.repeat(np.roll(ramp, t)[..., None], 3, -1).astype(np.uint8) for t in range(20)]
    video[7][10:30, 10:30] = (220, 90, 20)
    read = imageio.imread(write_video(tmp_path / "episode.gif", video, fps=4), index=7)
    assert np.abs(read[12:28, 12:28, :3].astype(int) - (220, 90, 20)).max() < 20


def test_a_gif_of_more_than_100_frames_per_second_has_all_frames(tmp_path):
    video = [np.full((8, 8, 3), 20 * i, np.uint8) for i in range(6)]
    path = write_video(tmp_path / "episode.gif", video, fps=240)
    assert len(imageio.imread(path, index=None)) == 6


def test_a_video_of_another_format_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"film.avi: a video is .mp4 or .gif"):
        write_video(tmp_path / "film.avi", [np.zeros((4, 4, 3), np.uint8)], 10)
