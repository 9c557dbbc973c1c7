"""Procedural fixtures and objects: geometry, textures and metadata without binary files."""
