"""How fast is it? Claims measured beside stock robosuite, both sides in one run."""
