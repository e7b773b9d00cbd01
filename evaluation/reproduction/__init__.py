"""The paper's section 6, claim by claim, beside what we get."""
