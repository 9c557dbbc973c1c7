"""The fixture `fake_loop`: commands without a policy and a simulator."""

from tests.support.fake_loop import fake_loop

__all__ = ["fake_loop"]
