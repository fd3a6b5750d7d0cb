"""The paper, run again and judged claim by claim."""
