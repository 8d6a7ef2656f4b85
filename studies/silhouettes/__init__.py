from studies.silhouettes.task import STEPS, Task

__all__ = ["STEPS", "Task"]
