"""The process on a robot's computer that records what its agent and plant say, in bounded segments."""
