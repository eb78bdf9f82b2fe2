"""A result with better cameras or lengths, as another result: external poses, bundle adjustment, known lengths."""
