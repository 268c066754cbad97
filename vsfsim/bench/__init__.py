"""Methods, tasks, metrics, results, leaderboard."""
