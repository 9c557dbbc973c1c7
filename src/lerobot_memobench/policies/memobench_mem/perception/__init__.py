"""How is a moment seen? One file per perception; cache and rollout use the same one."""
