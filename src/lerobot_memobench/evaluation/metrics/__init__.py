"""From rollouts to rates and failures."""
