"""Ground truth of every kind and damage, PNG files, colours."""

from __future__ import annotations

import io
import os

import numpy as np
import pytest
from PIL import Image

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.images import image_size, parse_colour, read_ground_truth, to_8_bits, write_png
from tests.cases.images import png_of
from tests.cases.memory import takes_at_most
from tests.cases.own_warnings import no_warnings


def random_pixels(channels, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (7, 9, channels), dtype=np.uint8)


def saved(path, pixels, **options):
    Image.fromarray(pixels).save(path, **options)
    return path


def test_colours_greys_and_webp(tmp_path):
    pixels, grey = random_pixels(3), random_pixels(1)[..., 0]
    image = read_ground_truth(saved(tmp_path / "a.png", pixels), (1, 1, 1))
    assert image.dtype == np.float32
    assert np.array_equal(image, pixels.astype(np.float32) / np.float32(255))
    assert image_size(tmp_path / "a.png") == (9, 7)
    found = [read_ground_truth(saved(tmp_path / name, pixels, lossless=True)) for name in ("a.png", "a.webp")]
    assert all(np.array_equal(to_8_bits(each), pixels) for each in found)
    image = read_ground_truth(saved(tmp_path / "a.png", grey))
    assert np.array_equal(to_8_bits(image), np.stack([grey] * 3, axis=-1))


def test_alpha_and_transparent_colours_show_the_background(tmp_path):
    path, pixels = tmp_path / "a.png", random_pixels(4)
    saved(path, pixels)
    background = np.array([1, 0.5, 0])
    alpha = pixels[..., 3:] / 255
    expected = pixels[..., :3] / 255 * alpha + background * (1 - alpha)
    assert np.abs(read_ground_truth(path, (1, 0.5, 0)) - expected).max() < 1e-6
    assert np.abs(read_ground_truth(path) - pixels[..., :3] / 255 * alpha).max() < 1e-6
    image = Image.new("P", (4, 4), 1)
    image.putpalette([255, 0, 0, 0, 255, 0])
    image.save(path, transparency=1)
    assert np.array_equal(read_ground_truth(path, (0, 0, 1)), np.full((4, 4, 3), (0, 0, 1)))


def test_deep_images_are_refused(tmp_path):
    path = saved(tmp_path / "a.png", np.arange(63, dtype=np.uint16).reshape(7, 9))
    with pytest.raises(DataError, match="more than 8 bits"):
        read_ground_truth(path)


@pytest.mark.parametrize("form", ["TIFF", "BMP", "GIF", "AVIF", "DDS", "EPS", "PPM", "TGA", "JPEG2000", "PCX", "BLP"])
def test_no_other_kind_of_image_is_read(tmp_path, form, monkeypatch):
    """Whatever it is called; some of Pillow's readers start other programs, others end in tracebacks."""
    started = []
    monkeypatch.setattr("subprocess.Popen", lambda *args, **kwargs: started.append(args))
    monkeypatch.setattr("os.system", started.append)
    path = tmp_path / ("a.tif" if form == "BMP" else "a.png")
    try:
        Image.fromarray(random_pixels(3)).convert("P" if form == "BLP" else "RGB").save(path, form)
    except (KeyError, OSError, ValueError):
        pytest.skip(f"this Pillow does not write {form}")
    for read in (image_size, read_ground_truth):
        with pytest.raises(DataError, match="no PNG, JPEG or WebP image that can be read"):
            read(path)
    assert not started


@pytest.mark.parametrize(("width", "height"), [(100_000, 1400), (13_000, 13_000), (60_000, 60_000)])
def test_too_many_pixels_are_refused_before_they_are_unpacked(tmp_path, width, height):
    path = tmp_path / "a.png"
    path.write_bytes(png_of(width, height))
    with takes_at_most(4 << 20), no_warnings():
        for read in (image_size, read_ground_truth):
            with pytest.raises(DataError, match="pixels"):
                read(path)
        path.write_bytes(png_of(10_000, 10_000))
        assert image_size(path) == (10_000, 10_000)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "a.png")  # which is not waited for
    for path, said in (("a.png", "not a regular file"), ("none.png", "cannot read"), (".", "cannot read")):
        with pytest.raises(UsageError, match=said):
            image_size(tmp_path / path)


@pytest.mark.parametrize("form", ["PNG", "JPEG"])
def test_damaged_files(tmp_path, form):
    path = tmp_path / "a"
    buffer = io.BytesIO()
    Image.fromarray(random_pixels(3).repeat(20, axis=0)).save(buffer, form)
    whole = buffer.getvalue()
    for content in (b"", b"not an image", whole[:10], whole[: len(whole) // 2], bytes(200)):
        path.write_bytes(content)
        with pytest.raises(DataError, match="damaged or of another kind"):
            read_ground_truth(path)


def test_a_size_that_would_not_fit_memory(tmp_path):
    path = saved(tmp_path / "a.jpg", random_pixels(3))
    data = bytearray(path.read_bytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = (50_000).to_bytes(2, "big") * 2
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"damaged or of another kind|pixels"):
        read_ground_truth(path)


def test_png_keeps_pixels_and_text():
    pixels, file = random_pixels(3), io.BytesIO()
    write_png(file, pixels, "what it shows")
    with Image.open(file) as image:
        assert np.array_equal(np.asarray(image), pixels)
        assert image.text == {"Description": "what it shows"}


@pytest.mark.parametrize(
    ("text", "colour"),
    [("0,0.5,1", (0, 0.5, 1)), (" 1, 1, 1 ", (1, 1, 1)), ("white", (1, 1, 1)), ("#ff0033", (1, 0, 0.2))],
)
def test_colours(text, colour):
    assert parse_colour(text) == pytest.approx(colour)


@pytest.mark.parametrize("text", ["", "1,1", "2,0,0", "nan,0,0", "-1,0,0", "blurple", "#12", "1,1,1,1"])
def test_no_colours(text):
    with pytest.raises(UsageError, match="unknown colour"):
        parse_colour(text)


def test_8_bits_are_clamped_and_rounded_in_little_memory():
    """One view of 16384 x 16384 pixels took three times its 3 GB."""
    values = np.array([-1, 0, 0.4999 / 255, 0.5001 / 255, 254.6 / 255, 1, 9])
    assert to_8_bits(values).tolist() == [0, 0, 0, 1, 255, 255, 255]
    image = np.random.default_rng(0).normal(0.5, 1, (2000, 900, 3)).astype(np.float32)
    with takes_at_most(image.size + (1 << 24)):
        found = to_8_bits(image)
    assert np.array_equal(found, np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))
    assert to_8_bits(image[:0]).shape == (0, 900, 3)
