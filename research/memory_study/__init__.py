"""The memory study: every mechanism on one backbone, with the same demonstrations, updates and scenes."""
