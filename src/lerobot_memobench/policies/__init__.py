"""Who learns it? The memory policy and the expert, as LeRobot policies."""
