"""Each trigger has one answer, whichever call of the loop fails: a part of the campaign."""

import pytest

from tests.campaigns.exceptions import SCENES, campaign

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(("lasting", "every"), [(False, 131), (True, 61)])
def test_every_trigger_is_answered(scene: str, lasting: bool, every: int):
    """An exception at a sample of the calls: no trigger without an answer, none with two."""
    told: list[str] = []
    runs, wrong = campaign(scene, every, lasting=lasting, report=told.append)
    assert runs > 5
    assert not wrong, told
