"""Scenes of LIBERO's assets: models, placements and pictures, built without LIBERO's simulator."""
