"""The rows that ship: TASK.json of each task, studies/TASK.json of its studies; and result files, TASK/METHOD.json."""
