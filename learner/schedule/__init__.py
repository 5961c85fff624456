"""When a window is updated and when it is held, where that is decided as the run goes."""
