"""The world and its clock: the one process that sleeps towards deadlines."""
