"""The paper's analysis on finite worlds: budgets, exact regret, and the bounds beside it. NumPy only."""
