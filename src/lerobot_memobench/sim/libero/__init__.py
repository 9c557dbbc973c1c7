"""The paper's world: LIBERO's scenes, contacts and predicates, built from LIBERO's assets without its simulator."""
