"""The deployed policy on its way to the robot."""
