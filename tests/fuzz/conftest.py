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
    parser.addoption(
        "--flood",
        type=int,
        default=4_000,
        help="messages to send to real processes: pytest tests/fuzz --flood N --timeout 600",
    )


@pytest.fixture(scope="session")
def messages(request: pytest.FixtureRequest) -> int:
    """Mutated messages for the services in virtual time."""
    number: int = request.config.getoption("messages", default=100_000)
    return number


@pytest.fixture(scope="session")
def flood(request: pytest.FixtureRequest) -> int:
    """Messages for real processes."""
    number: int = request.config.getoption("flood", default=4_000)
    return number
