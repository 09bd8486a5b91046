"""What every source must do: the contract of `interfaces.Source`, on small recordings."""

from __future__ import annotations

from functools import partial
from itertools import islice

import pytest
from documentation import write_recordings
from fakes import FakeSource
from hydra import compose, initialize_config_module
from hydra.utils import instantiate

from sceneslam.testing import SOURCE_CHECKS, ContractError, check_source, sources

RECORDINGS = {"mcap": "FILE.mcap", "tum_rgbd": "freiburg1", "video": "clip.mp4"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings")
    write_recordings(path)
    return path


@pytest.mark.parametrize("check", SOURCE_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("source", RECORDINGS)
def test_source_keeps_its_contract(folder, source, check):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        node = compose("config", overrides=[f"source={source}"]).source
    node.path = str(folder / RECORDINGS[source])
    check(partial(instantiate, node, _convert_="all"))


class Backwards(FakeSource):
    """Yields a drive from its end."""

    def __iter__(self):
        return reversed(list(islice(super().__iter__(), 5)))


class Undeclared(FakeSource):
    """Measures images that its rig does not name."""

    def __init__(self):
        super().__init__(5, 5)
        self.rig = type(self.rig)(sensors=frozenset())


def test_a_source_that_breaks_its_contract_is_found():
    with pytest.raises(ContractError, match="rising stamps"):
        sources.yields_by_rising_stamp(lambda: Backwards(5, 5))
    with pytest.raises(ContractError, match=r"rig.sensors with image"):
        check_source(Undeclared)
