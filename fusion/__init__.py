"""Back ends, evaluation and the main job."""
