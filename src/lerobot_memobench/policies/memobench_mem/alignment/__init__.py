"""What ties memory to the text of the checkpoint being worked on? In training only."""
