from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest
from skimage.color import rgb2xyz, xyz2rgb

from controller.stage.report.pictures import (
    ERROR_SCALE_DELTA_E,
    crop_around,
    data_uri,
    error_picture,
    fitted,
    scale_bar,
    to_screen,
)

SRGB_TO_XYZ = np.array([rgb2xyz(np.eye(3)[None, None, k])[0, 0] for k in range(3)]).T


def test_a_camera_that_sees_as_a_screen_shows_is_encoded_as_srgb() -> None:
    rng = np.random.default_rng(3)
    linear = rng.uniform(0, 1, (5, 7, 3)).astype(np.float32)
    expected = xyz2rgb(linear.astype(np.float64) @ SRGB_TO_XYZ.T)
    shown = to_screen(2.5 * linear, SRGB_TO_XYZ, white=2.5)
    assert shown.dtype == np.uint8
    np.testing.assert_allclose(shown, 255 * expected, atol=1.5)


def test_white_is_white_and_what_is_brighter_dark_or_unknown_is_in_range() -> None:
    image = np.array([[[1, 1, 1], [9, 9, 9], [-1, -1, -1], [np.nan] * 3]], np.float32)
    rows = to_screen(image, SRGB_TO_XYZ, white=1.0)[0]
    assert rows.tolist() == [[255] * 3, [255] * 3, [0] * 3, [0] * 3]


def test_the_error_maps_scale_is_fixed_and_grey_outside() -> None:
    delta_e = np.array([[0.0, 0.5 * ERROR_SCALE_DELTA_E, ERROR_SCALE_DELTA_E, 1e6, np.nan]], np.float32)
    mask = np.array([[True, True, True, True, False]])
    picture = error_picture(delta_e, mask)[0].astype(int)
    brightness = picture.sum(axis=1)
    assert brightness[0] < brightness[1] < brightness[2] == brightness[3]
    assert len(set(picture[4])) > 1
    bar = scale_bar()
    np.testing.assert_array_equal(bar[0, 0], picture[0])
    np.testing.assert_array_equal(bar[0, -1], picture[2])


def test_a_crop_holds_the_object_with_a_margin_inside_the_image() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[10:31, 0:50] = True
    crop = crop_around(mask, margin=0.1)
    assert (crop.rows, crop.columns) == (slice(6, 35), slice(0, 54))
    empty = crop_around(np.zeros((40, 60), np.bool_))
    assert (empty.rows, empty.columns) == (slice(0, 40), slice(0, 60))


@pytest.mark.parametrize(("shape", "expected"), [((10, 20), (10, 20)), ((100, 40), (50, 20)), ((3, 500), (1, 50))])
def test_pictures_are_shrunk_and_never_enlarged(shape: tuple[int, int], expected: tuple[int, int]) -> None:
    assert fitted(np.zeros((*shape, 3), np.uint8), longest_px=50).shape[:2] == expected


def test_an_embedded_picture_is_the_picture() -> None:
    image = np.zeros((16, 32, 3), np.uint8)
    image[:, :16] = (200, 30, 40)
    head, _, content = data_uri(image).partition(",")
    assert head == "data:image/jpeg;base64"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    np.testing.assert_allclose(decoded[8, 4, ::-1], (200, 30, 40), atol=6)
    np.testing.assert_allclose(decoded[8, 28], 0, atol=6)
