"""How does a scene become a picture? One list of triangles, drawn with OpenGL."""
