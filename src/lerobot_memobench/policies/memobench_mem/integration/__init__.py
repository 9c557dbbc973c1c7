"""How do actions read memory? One file per integration."""
