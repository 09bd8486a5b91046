"""What a check says when a promise is broken."""

from __future__ import annotations


class ContractError(AssertionError):
    """A component does not do what its interface promises."""


def expect(holds: object, promise: str, found: object = "") -> None:
    """Raise ContractError with the promise, and what was found, unless it holds."""
    if not holds:
        raise ContractError(f"{promise}; got {found}" if found != "" else promise)
