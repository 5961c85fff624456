"""The witness: writes the run's timeline to `recording.rrd`, and streams it to a viewer on request."""
