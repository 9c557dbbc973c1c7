"""pi0.5 with a visual memory and three ways of aligning it to checkpoint text (paper, appendix on alignment)."""
