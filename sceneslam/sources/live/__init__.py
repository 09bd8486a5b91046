"""What sources that measure now share: their clocks, their silences, and what waits."""
