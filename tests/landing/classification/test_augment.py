"""What is varied in the images of a training."""

from typing import Any

import cv2
import numpy as np
import pytest

from support.labelled_images_support import coloured


@pytest.fixture
def augment(torch: Any) -> Any:
    from touchdown.landing.classification.learning import augment

    return augment


def test_variations_keep_the_kind_of_picture(torch: Any, augment: Any) -> None:
    images = augment.as_input(torch.from_numpy(coloured(12, 2).images))
    results = [augment.augmented(images, torch.Generator().manual_seed(s)) for s in (1, 1, 2)]
    assert results[0].shape == images.shape
    assert float(results[0].min()) >= 0.0 and float(results[0].max()) <= 1.0
    assert bool((results[0] == results[1]).all()) and bool((results[0] != results[2]).any())


def test_lines_are_painted_on_a_share_of_the_pictures(torch: Any, augment: Any) -> None:
    plain = torch.full((400, 3, 48, 48), 0.3)
    painted = augment.marked(plain, torch.Generator().manual_seed(5), 0.25)
    changed = ((painted - plain).abs().amax(dim=1) > 0.02).float().mean(dim=(1, 2))
    count = int((changed > 0.0).sum())
    assert 70 <= count <= 130, "a quarter, four deviations of a binomial count to either side"
    some = changed[changed > 0.0]
    assert float(some.max()) < 0.5, "a line is at most a quarter as wide as its period, and an edge"
    assert float(some.mean()) > 0.01 and float(painted.min()) >= 0.0 and float(painted.max()) <= 1.0
    assert torch.equal(augment.marked(plain, torch.Generator().manual_seed(5), 0.0), plain)
    without, none = (
        augment.augmented(plain[:4], torch.Generator().manual_seed(7), 1.0, *markings)
        for markings in ((), (0.0,))
    )
    assert torch.equal(without, none)


def test_some_lines_are_the_outline_of_a_court(torch: Any, augment: Any) -> None:
    """Only within an outline is there plain ground that reaches no edge of the image."""
    plain = torch.full((400, 3, 64, 64), 0.3)
    painted = augment.marked(plain, torch.Generator().manual_seed(5), 1.0)
    bare = ((painted - plain).abs().amax(dim=1) < 0.02).numpy().astype(np.uint8)
    enclosed = 0
    for image in bare:
        parts, _, boxes, _ = cv2.connectedComponentsWithStats(image, connectivity=4)
        first, last = boxes[1:parts, :2], boxes[1:parts, :2] + boxes[1:parts, 2:4]
        inner = (first > 0).all(axis=1) & (last < 64).all(axis=1) & (boxes[1:parts, 4] > 30)
        enclosed += int(inner.any())
    assert 8 <= enclosed <= 80


def test_lanes_over_lines_two_sets_of_which_one_is_as_likely_as_the_other(
    torch: Any, augment: Any
) -> None:
    """Of a fraction of 0.5 three quarters have one set at least, but for those that are too
    faint."""
    plain = torch.full((300, 3, 48, 48), 0.3)
    painted = augment.augmented(plain, torch.Generator().manual_seed(5), 0.0, 0.5)
    fraction = float(((painted - plain).abs().amax(dim=(1, 2, 3)) > 0.02).float().mean())
    assert 0.6 < fraction <= 0.85


def test_a_share_of_the_pictures_has_another_colour_but_plants(torch: Any, augment: Any) -> None:
    spreads = augment.colour_spreads(("lawn", "water", "road", "trees"))
    assert spreads.shape == (5, 4) and torch.equal(spreads[-1], spreads[2])
    labels = torch.arange(5).repeat_interleave(500) - 1
    plain = torch.full((2500, 3, 1, 1), 0.05)
    given = augment.recoloured(plain, spreads[labels], torch.Generator().manual_seed(5), 0.5)
    logs = 2.2 * torch.log(given / plain)[:, :, 0, 0]  # of linear light
    changed = logs.abs().amax(dim=1) > 1e-4
    assert not changed[labels == 0].any() and not changed[labels == 3].any()
    for label, (light, warm, green) in (
        (1, (0.5, 0.6, 0.2)),
        (2, (0.4, 0.5, 0.12)),
        (-1, (0.4, 0.5, 0.12)),
    ):
        rows = changed & (labels == label)
        assert 190 <= int(rows.sum()) <= 310
        red, mid, blue = logs[rows].unbind(dim=1)
        found = [0.5 * (red + blue), 0.5 * (red - blue), mid - 0.5 * (red + blue)]
        assert [float((values**2).mean().sqrt()) for values in found] == pytest.approx(
            [light, warm, green], rel=0.2
        )
        assert (float(found[1].min()) < -0.5) == (label == 1), "only water gets bluer"


def test_a_picture_takes_on_the_colour_of_a_texture_and_keeps_its_shadows(
    torch: Any, augment: Any
) -> None:
    images = torch.full((2, 3, 8, 8), 0.4)
    images[1, :, :, :4] = 0.2
    images[1, :, :, 4:] = 0.6
    colour = torch.tensor([0.5, 0.3, 0.2])[:, None, None]
    found = augment.textured(images, colour.expand(2, 3, 8, 8), torch.Generator().manual_seed(1))
    torch.testing.assert_close(found[0], colour.expand(3, 8, 8))
    torch.testing.assert_close(found[1, :, :, :4], 0.5 * colour.expand(3, 8, 4))
    torch.testing.assert_close(found[1, :, :, 4:], 1.5 * colour.expand(3, 8, 4))
    grain = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(2))
    assert float(augment.textured(images, grain, torch.Generator().manual_seed(1))[0].std()) > 0.05


def test_weather_falls_on_shares_of_the_pictures(torch: Any, augment: Any) -> None:
    plain = torch.full((400, 3, 32, 32), 0.4)
    changed = augment.weathered(plain, torch.Generator().manual_seed(5))
    assert float(changed.min()) >= 0.0 and float(changed.max()) <= 1.0
    left = ((changed - plain).abs().amax(dim=(1, 2, 3)) < 1e-5).float().mean()
    fractions = [fraction for name, fraction in augment._FRACTIONS.items() if name != "coarse"]
    expected = float(np.prod([1.0 - fraction for fraction in fractions]))
    assert float(left) == pytest.approx(expected, abs=3.0 * np.sqrt(expected / 400))
    again = augment.weathered(plain, torch.Generator().manual_seed(5))
    assert torch.equal(changed, again)
    assert torch.equal(augment.weathered(plain, torch.Generator().manual_seed(5), 0.0), plain)


def test_effects_of_weather_by_their_kind(torch: Any, augment: Any) -> None:
    """Haze loses contrast, wet ground light, coarse pictures detail, and snow is bright."""
    checks = (torch.arange(32) % 2).float()
    board = (0.2 + 0.4 * (checks[:, None] - checks).abs()).expand(8, 3, 32, 32).clone()

    def after(name: str) -> Any:
        return augment._EFFECTS[name](board, torch.Generator().manual_seed(3))

    assert float(after("haze").std()) < float(board.std()) and float(after("haze").mean()) > 0.42
    assert float(after("wet").mean()) < 0.9 * float(board.mean())
    assert float(after("coarse").std()) < 0.3 * float(board.std())
    assert float(after("snow").mean()) > float(board.mean())
    assert float(after("shadows").mean()) < float(board.mean())
    warm = after("low sun").mean(dim=(0, 2, 3))
    assert warm[0] > warm[1] > warm[2]
    assert float(after("lamp")[..., 0, 0].mean()) < float(after("lamp")[..., 16, 16].mean())
