"""Does a mechanism help? Policies trained and compared under one budget."""
