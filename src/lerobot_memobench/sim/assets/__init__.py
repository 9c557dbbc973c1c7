"""Fixtures and objects as code: geometry, textures and the facts about them, without binary files."""
