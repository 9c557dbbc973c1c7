"""Perception: a visual encoder, and an object detector on top of it; what is needed to act.

`visual_encoder` makes tokens of images. `detector` finds objects in them, `weights` keeps both in one file, `objects`
places the detections of both cameras in the world by `geometry`. `research.detector` trains and tests them.
"""
