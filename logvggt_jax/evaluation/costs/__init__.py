"""What a sequence costs: operations, time, memory."""
