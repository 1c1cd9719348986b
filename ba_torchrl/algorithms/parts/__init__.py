"""Parts of algorithms: settings that build what a learner is made of."""
