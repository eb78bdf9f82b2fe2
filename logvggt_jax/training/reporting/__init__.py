"""What a run says of itself: metrics, times, progress, traces."""
