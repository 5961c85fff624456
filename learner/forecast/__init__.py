"""Forecasts: of a Q function, of a drift, and how far they can be trusted."""
