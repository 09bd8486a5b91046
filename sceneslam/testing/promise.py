"""The error of contract checks."""

from __future__ import annotations

from collections.abc import Callable


class ContractError(AssertionError):
    """A component violates the contract of its interface."""


def expect(holds: object, promise: str, found: object = "") -> None:
    """Raise ContractError with the requirement and what was found, unless it holds."""
    if not holds:
        raise ContractError(f"{promise}; got {found}" if found != "" else promise)


def accepted(check: Callable[..., object], *answer: object) -> None:
    """Raise ContractError where the bus would stop a component for its answer."""
    try:
        check(*answer)
    except (TypeError, ValueError) as error:
        raise ContractError(str(error)) from error
