"""Effects on messages are counted on delivery, by what differs."""

import numpy as np
import pytest

from touchdown.sim.effects import Effects, Returns


def test_effects_count_once_their_message_is_delivered() -> None:
    effects = Effects()
    for share in (0.5, 0.0, 1.0):
        effects.note(("fog", "rain"), share, 10.0 * share)
        effects.end_message()
    assert effects.delivered == {}
    effects.deliver(2)
    fog = effects.delivered["fog"]
    assert (fog.came, fog.messages, fog.mean_share, fog.mean_amount) == (2, 1, 0.25, 2.5)
    assert effects.delivered["rain"] == fog
    effects.deliver(1)
    assert effects.delivered["fog"].messages == 2
    effects.clear()
    assert effects.delivered == {}


def test_images_and_lengths_that_differ() -> None:
    effects = Effects()
    before = np.full((16, 32, 3), 100, np.uint8)
    after = before.copy()
    after[:, :16] = 108  # of the compared pixels one half
    effects.note_image(("lens_dirt",), before, after)
    effects.note_lengths("sway", 4, 2, 1.5)
    effects.end_message()
    effects.deliver(1)
    dirt, sway = effects.delivered["lens_dirt"], effects.delivered["sway"]
    assert (dirt.mean_share, dirt.mean_amount) == (0.5, 4.0)
    assert sway.mean_share == 0.5 and sway.mean_amount == pytest.approx(0.75)


def test_returns_that_differ() -> None:
    seen = Returns(np.array([5, 5, 5, 0], np.float32), np.array([50, 50, 50, 0], np.uint8))
    before = seen.copy()
    seen.ranges[:] = [5.05, 0.0, 5.0, 3.0]
    seen.intensity[:] = [50, 0, 49, 9]
    assert seen.changed_share(before) == 0.75
    assert seen.changed_share(seen.copy()) == 0.0
