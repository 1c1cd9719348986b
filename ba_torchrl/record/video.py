"""Videos of episodes: their frames, and their files."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ba_torchrl.core.files import atomic_file

if TYPE_CHECKING:
    from ba_torchrl.envs.base import BulletArmEnv

_CAPTION_SIZE = 13
_CAPTION_MARGIN = 6
_CAPTION_RGB = (70, 70, 70)

_OPTIONS = {
    ".mp4": ("-vcodec", "libx264", "-pix_fmt", "yuv420p"),
    # one palette for all frames, and no dither, halve the size
    ".gif": ("-vf", "split[a][b];[a]palettegen=128[p];[b][p]paletteuse=dither=none", "-loop", "0"),
}
"""Of ffmpeg, by suffix. Colours of yuv420p have half of the resolution, hence even sizes."""
VIDEO_SUFFIXES = tuple(_OPTIONS)


class FrameRecorder:
    """Renders an environment into a list of frames.

    An open-loop step gives two frames: the grasp or the release, recorded during the step, and the
    scene after the step, recorded by `record`. With ``motion``, frames between them show the arm
    move, with a caption that says so, and all frames show the whole arm.

    Args:
        width: number of columns of a frame.
        height: number of rows of a frame.
        motion: show the interpolated motion of the arm in open loop.
    """

    def __init__(
        self, env: BulletArmEnv, width: int = 400, height: int = 400, *, motion: bool = False
    ) -> None:
        self.env = env
        self.motion = motion
        self.size = (width, height)
        self.frames: list[np.ndarray] = []
        """[height, width, 3] uint8 each, in the order of time."""
        self.contacts: list[int] = []
        """Indices of the frames that show a grasp or a release."""
        env.on_contact = self._record_contact

    def _record_contact(self) -> None:
        self.record(at_contact=True)
        self.contacts.append(len(self.frames) - 1)

    def record(self, *, at_contact: bool = False) -> None:
        """Append an image of the current scene, with ``motion`` after those that lead to it."""
        if not self.motion:
            self.frames.append(self.env.render(*self.size))
            return
        for image in self.env.video_images(*self.size, at_contact=at_contact):
            self.frames.append(_with_caption(image, self.env.video_caption))


def write_video(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> Path:
    """Write images as a video, ``.mp4`` (H.264) or ``.gif``, and return its path.

    The frames [H, W, 3] are uint8 of equal size. For ``.mp4``, an odd height or width is padded
    with a copy of the last row or column. Frames of a ``.gif`` last at least 10 ms.

    Raises:
        ValueError: the path has another suffix.
    """
    import imageio_ffmpeg

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _OPTIONS:
        raise ValueError(f"{path}: a video is {' or '.join(_OPTIONS)}")
    pictures = list(frames) if suffix == ".gif" else list(map(_even, frames))
    height, width = pictures[0].shape[:2]
    if suffix == ".gif":
        fps = min(fps, 100)
    source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps))
    folder = Path(os.path.realpath(path)).parent
    folder.mkdir(parents=True, exist_ok=True)
    # a file without a name, of which a killed process leaves nothing
    with tempfile.TemporaryFile(dir=folder) as film:
        # not by the writer of imageio_ffmpeg, which does not report the exit code
        done = subprocess.run(
            [
                *(imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-xerror"),
                *(*source, "-i", "-"),
                *(*_OPTIONS[suffix], "-f", suffix[1:], f"/dev/fd/{film.fileno()}"),
            ],
            input=b"".join(picture.tobytes() for picture in pictures),
            capture_output=True,
            check=False,
            pass_fds=[film.fileno()],
        )
        if done.returncode:
            lines = done.stderr.decode(errors="replace").splitlines() or ["no reason given"]
            raise OSError(errno.EIO, f"ffmpeg: {lines[0].split('] ')[-1]}")
        film.seek(0)
        with atomic_file(path) as scratch, scratch.open("wb") as file:
            shutil.copyfileobj(film, file)
    return path


def _with_caption(picture: np.ndarray, text: str) -> np.ndarray:
    """Return an image with a text in its lower left corner."""
    if not text:
        return picture
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    position = (_CAPTION_MARGIN, picture.shape[0] - _CAPTION_MARGIN)
    ImageDraw.Draw(image).text(position, text, _CAPTION_RGB, anchor="ls", font_size=_CAPTION_SIZE)
    return np.asarray(image)


def _even(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
