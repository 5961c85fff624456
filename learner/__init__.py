"""The student: replay, critics, forecasts, policy improvement, and when to publish it."""
