"""What is kept for ever and compared with: the paper's verdicts, and logs of former versions."""
