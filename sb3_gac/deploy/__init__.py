"""The export of the deployed policy for the robot."""
