"""Perception for acting policies: a visual encoder and an object detector.

`visual_encoder` maps images to tokens, `detector` finds objects, `objects` places the detections of both cameras in
the world. `research.detector` trains and measures them.
"""
