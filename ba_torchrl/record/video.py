"""Videos of episodes: their frames, and their files."""

from __future__ import annotations

import errno
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ba_torchrl.core.files import replaced

if TYPE_CHECKING:
    from ba_torchrl.envs.base import BulletArmEnv

_GIF_COLORS = 128
_PALETTE_STRIDE = 4
"""Distance of the pixels from which the colours of a GIF are chosen."""
_CAPTION_SIZE = 13
_CAPTION_MARGIN = 6
_CAPTION_RGB = (70, 70, 70)


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
    with a copy of the last row or column.
    """
    import imageio
    import imageio_ffmpeg

    path = Path(path)
    with replaced(path) as scratch:
        if path.suffix.lower() == ".gif":
            gif = _with_common_colors(frames)
            options = {"format": "gif", "duration": 1000 / fps, "loop": 0}
            scratch.write_bytes(imageio.mimwrite("<bytes>", gif, **options))
        else:
            _encode(imageio_ffmpeg.get_ffmpeg_exe(), list(map(_even, frames)), fps, scratch)
    return path


def _encode(program: str, pictures: Sequence[np.ndarray], fps: float, path: Path) -> None:
    """Run ffmpeg, whose exit code imageio does not report.

    yuv420p halves the resolution of chroma, hence even sizes.
    """
    height, width = pictures[0].shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps)]
    target = ["-vcodec", "libx264", "-pix_fmt", "yuv420p", str(path)]
    done = subprocess.run(
        [program, "-y", "-v", "error", "-xerror", *source, "-i", "-", *target],
        input=b"".join(picture.tobytes() for picture in pictures),
        capture_output=True,
        check=False,
    )
    if done.returncode:
        lines = done.stderr.decode(errors="replace").splitlines() or ["no reason given"]
        raise OSError(errno.EIO, f"ffmpeg: {lines[0].split('] ')[-1]}")


def _with_common_colors(pictures: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return frames with `_GIF_COLORS` colours, which halves the size of a GIF."""
    from PIL import Image

    sample = np.vstack([picture[::_PALETTE_STRIDE, ::_PALETTE_STRIDE] for picture in pictures])
    palette = Image.fromarray(sample).quantize(_GIF_COLORS, kmeans=2, dither=Image.Dither.NONE)
    return [
        np.asarray(
            Image.fromarray(picture)
            .quantize(palette=palette, dither=Image.Dither.NONE)
            .convert("RGB")
        )
        for picture in pictures
    ]


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
