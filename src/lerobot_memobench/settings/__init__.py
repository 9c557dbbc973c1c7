"""What may be said on a command line, and what does it mean to LeRobot?"""
