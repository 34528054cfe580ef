"""The paper's experiment run again, its filter, what it prints, and what it says against itself."""
