"""The rows that ship, TASK/METHOD.json and studies/TASK/NAME.json, the list of what made them, and audits."""
