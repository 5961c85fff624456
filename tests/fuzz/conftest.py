"""How much the fuzz tests send."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--messages",
        type=int,
        default=100_000,
        help="mutated messages to send: pytest tests/fuzz --messages N",
    )


@pytest.fixture(scope="session")
def messages(request: pytest.FixtureRequest) -> int:
    """Mutated messages for the services in virtual time."""
    number: int = request.config.getoption("messages", default=100_000)
    return number
