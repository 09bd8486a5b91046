"""The error of contract checks."""

from __future__ import annotations


class ContractError(AssertionError):
    """A component violates the contract of its interface."""


def expect(holds: object, promise: str, found: object = "") -> None:
    """Raise ContractError with the requirement and what was found, unless it holds."""
    if not holds:
        raise ContractError(f"{promise}; got {found}" if found != "" else promise)
