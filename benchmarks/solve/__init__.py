"""Problems of the joint solve whose every truth is known, which tests and studies share."""
