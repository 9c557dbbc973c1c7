"""How are words read? The prompt's tokenizer, and the encoders of subgoal texts."""
