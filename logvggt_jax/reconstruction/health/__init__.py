"""What the frames, the cameras and the method's own signals say about a result's quality, and why."""
