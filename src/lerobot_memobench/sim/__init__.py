"""How does a task move and look? The scene, the arm, pictures; predicates answered by physics."""
