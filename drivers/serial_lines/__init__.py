"""Driver for custom encoders on a microcontroller that sends lines of text, with an emulator."""
