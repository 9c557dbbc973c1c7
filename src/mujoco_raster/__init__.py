"""CPU rasterizer: draw a scene as one list of triangles, bit-equal on every machine."""
