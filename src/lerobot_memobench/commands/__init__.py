"""Parse command lines into LeRobot's typed configurations, and call LeRobot's commands."""
