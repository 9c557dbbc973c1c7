"""How does torch compute quickest on this CPU? What training may use of it, policies and eyes alike."""
