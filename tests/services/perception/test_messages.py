"""A depth image and a camera are what they say, or refused."""

import math
from typing import Any

import numpy as np
import pytest

from services.bus.messages import CameraInfo, Image, MalformedMessageError, RegionOfInterest, header
from services.perception.messages import depth_array, pinhole

WIDTH, HEIGHT = 4, 3


def image(**fields: Any) -> Image:
    depth = np.arange(WIDTH * HEIGHT, dtype=np.float32)
    sound: dict[str, Any] = {
        "height": HEIGHT,
        "width": WIDTH,
        "encoding": "32FC1",
        "is_bigendian": 0,
        "step": 4 * WIDTH,
        "data": depth.view(np.uint8),
    }
    return Image(header=header(0, "camera"), **(sound | fields))


def camera(**intrinsics: float) -> CameraInfo:
    lens = {"fx": 32.0, "fy": 32.0, "cx": 31.5, "cy": 17.5} | intrinsics
    k = np.array([lens["fx"], 0, lens["cx"], 0, lens["fy"], lens["cy"], 0, 0, 1.0])
    roi = RegionOfInterest(0, 0, 0, 0, do_rectify=False)
    return CameraInfo(
        header(0, "camera"), 36, 64, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), np.zeros(12), 0, 0, roi
    )


def test_a_sound_image_is_an_array_row_by_row() -> None:
    depth = depth_array(image())
    assert depth.shape == (HEIGHT, WIDTH)
    assert depth[1, 2] == WIDTH + 2


@pytest.mark.parametrize(
    "fields",
    [
        {"width": 0, "height": 0, "data": np.empty(0, dtype=np.uint8)},
        {"data": np.empty(0, dtype=np.uint8)},
        {"data": np.zeros(4 * WIDTH * HEIGHT - 1, dtype=np.uint8)},
        {"width": 2**32 - 1, "height": 2**32 - 1},
        {"height": HEIGHT + 1},
        {"encoding": "rgb8"},
        {"is_bigendian": 1},
    ],
)
def test_an_image_without_pixels_or_of_another_size_is_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(MalformedMessageError, match="depth image"):
        depth_array(image(**fields))


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, -32.0])
def test_a_camera_that_cannot_be_is_refused(name: str, value: float) -> None:
    assert pinhole(camera()) == (32.0, 32.0, 31.5, 17.5)
    if name in ("cx", "cy") and math.isfinite(value):
        return
    with pytest.raises(MalformedMessageError, match="camera"):
        pinhole(camera(**{name: value}))
