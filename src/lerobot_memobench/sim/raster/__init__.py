"""How does a scene become a picture? One list of triangles, drawn on the CPU, to equal bits on every machine."""
