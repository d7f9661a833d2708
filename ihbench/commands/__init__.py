"""One module per command: its options as a frozen dataclass, and `main(argv) -> exit status`."""
