"""Contract checks of your own components, for the tests of your own package.

    from sceneslam.testing import check_module

    def test_my_module_keeps_the_contract():
        check_module(lambda: MySlam(max_depth_m=4.0))

Every check raises ContractError, an AssertionError, with a sentence on what is required by
`sceneslam.interfaces` and what was found. The lists hold the single checks, for one test each.
"""

from sceneslam.testing.detectors import DETECTOR_CHECKS, check_detector
from sceneslam.testing.modules import MODULE_CHECKS, check_module
from sceneslam.testing.promise import ContractError
from sceneslam.testing.room import RIG, room_observation
from sceneslam.testing.sources import SOURCE_CHECKS, check_source

__all__ = [
    "DETECTOR_CHECKS",
    "MODULE_CHECKS",
    "RIG",
    "SOURCE_CHECKS",
    "ContractError",
    "check_detector",
    "check_module",
    "check_source",
    "room_observation",
]
