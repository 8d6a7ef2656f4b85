"""The hard event sensor: its parameters, its state, its kernel, and v2e's timing."""
