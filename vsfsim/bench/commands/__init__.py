"""What the commands of the benchmark and the functions of `import vsfsim` call."""
