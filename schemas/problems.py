"""Every error code of Pliant, in one table: HTTP status, title, cause and remedy.

The service serves an entry at ``/errors/CODE`` and names that address in `Problem.type`. The reference page of the documentation
is generated from the same table, and a test compares the table with the codes that the sources raise.
"""

from __future__ import annotations

from enum import StrEnum

RETRYABLE_STATUSES = frozenset({408, 429, 503, 504, 507})
"""Statuses after which the same request can succeed later."""


class ProblemCode(StrEnum):
    """Stable machine-readable name of an error.

    Attributes
    ----------
    status : int or None
        Usual HTTP status; None if no HTTP answer carries the code, or its status varies.
    heading : str
        Short name for people.
    cause : str
        When it occurs.
    remedy : str
        What to do.
    """

    status: int | None
    heading: str
    cause: str
    remedy: str

    def __new__(cls, code: str, status: int | None, heading: str, cause: str, remedy: str) -> ProblemCode:
        """Make a member whose value is the code."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.status, member.heading, member.cause, member.remedy = status, heading, cause, remedy
        return member

    @property
    def path(self) -> str:
        """Path of the service that explains the code."""
        return type_of(self)

    @property
    def retryable(self) -> bool:
        """True if the same request can succeed later."""
        return self.status in RETRYABLE_STATUSES

    # fmt: off
    # Requests
    BAD_REQUEST = ("bad_request", 400, "Bad request",
     "The request could not be parsed.",
     "Compare it with the API reference at /docs, or let an HTTP library build it.")
    MALFORMED_FORM = ("malformed_form", 400, "Malformed form",
     "The multipart body is not valid: no boundary, a part without a name, or a body that ends early.",
     "Let an HTTP library write the body.")
    NO_SUCH_ADDRESS = ("no_such_address", 404, "No such address",
     "No route has this path.",
     "Check the path against the API reference at /docs.")
    METHOD_NOT_ALLOWED = ("method_not_allowed", 405, "Method not allowed",
     "The path exists, but not with this method.",
     "See the methods in the API reference at /docs.")
    BODY_STALLED = ("body_stalled", 408, "Body stalled",
     "No byte of the body arrived for 60 s.",
     "Send the request again. For large files use `PUT /v1/uploads/{id}`, which resumes.")
    PRECONDITION_FAILED = ("precondition_failed", 412, "Precondition failed",
     "`If-Match` named another version of the file than the stored one.",
     "Download the file from the beginning.")
    BODY_TOO_LARGE = ("body_too_large", 413, "Body too large",
     "The body exceeds `max_body_bytes` of `GET /v1/limits`.",
     "Send fewer frames or points, store `float32`, or ask the operator to raise `PLIANT_MAX_BODY_MB`.")
    TEXT_TOO_LARGE = ("text_too_large", 413, "Text too large",
     "A text part of the form exceeds 1 MiB.",
     "Send that part as a file, or shorten it.")
    UNSUPPORTED_MEDIA_TYPE = ("unsupported_media_type", 415, "Unsupported media type",
     "The body of a submission is not `multipart/form-data`.",
     "Send a form, for example `curl -F tracks=@tracks.npz`.")
    RANGE_NOT_SATISFIABLE = ("range_not_satisfiable", 416, "Range not satisfiable",
     "The requested byte range lies outside the file.",
     "Ask for a range inside the size that the answer's `Content-Range` states.")
    UNKNOWN_HOST = ("unknown_host", 421, "Unknown host",
     "The `Host` header is none of the names that the service answers for. This stops DNS rebinding.",
     "Use a listed name, or ask the operator to add it to `PLIANT_ALLOWED_HOSTS`.")
    INVALID_REQUEST = ("invalid_request", 422, "Invalid request",
     "A path, query or header parameter has a wrong type or value; `field` names it.",
     "Correct that parameter.")
    UNKNOWN_PART = ("unknown_part", 422, "Unknown part",
     "The form has a part that a submission does not have.",
     "Remove it; `expected` lists the parts.")
    REPEATED_PART = ("repeated_part", 422, "Repeated part",
     "A part was sent twice, or both as a file and as an upload (`tracks` and `tracks_upload`).",
     "Send it once.")
    MISSING_PART = ("missing_part", 422, "Missing part",
     "A required part, usually `tracks`, is absent.",
     "Add it.")
    CONFLICTING_PARTS = ("conflicting_parts", 422, "Conflicting parts",
     "A form has parts that exclude each other: a film beside tracks, or a mask picture beside `region_polygon`.",
     "Omit one of them.")
    NOT_A_FILE = ("not_a_file", 422, "Part is not a file",
     "A part that must be a file was sent as text.",
     "Give the part a file name, as `curl -F tracks=@FILE` does.")
    NOT_UTF8 = ("not_utf8", 422, "Not UTF-8",
     "A text part is not valid UTF-8.",
     "Encode it as UTF-8.")
    INVALID_PRIORITY = ("invalid_priority", 422, "Invalid priority",
     "The part `priority` is not one of high, normal and low.",
     "Leave it out for normal.")
    NAME_TOO_LONG = ("name_too_long", 422, "Name too long",
     "The job's `name` has more than 200 characters.",
     "Shorten it.")
    INVALID_LIMIT = ("invalid_limit", 422, "Invalid limit",
     "`limit` of a listing is outside its range.",
     "Ask for fewer jobs at once and follow `next`.")
    INVALID_CURSOR = ("invalid_cursor", 422, "Invalid cursor",
     "`cursor` is not the `next` value of an earlier page.",
     "Start the listing again without a cursor.")
    INVALID_EVENT_ID = ("invalid_event_id", 422, "Invalid event id",
     "`Last-Event-ID` is not the id of an event of this service.",
     "Omit the header to receive all events that are kept.")
    HTTP_ERROR = ("http_error", None, "Request refused",
     "The web framework refused the request for a reason without a code of its own.",
     "Read `detail`.")
    INTERNAL_ERROR = ("internal_error", 500, "Internal error",
     "An unexpected exception: a defect in Pliant.",
     "Report it with the service's log or the job's log.")
    NOT_READY = ("not_ready", 503, "Service not ready",
     "The job store, the blob store or every worker is missing; `detail` names the part.",
     "Start the missing part.")
    CONFLICTING_HEADERS = ("conflicting_headers", 400, "Conflicting headers",
     "A header that may occur once, such as `Idempotency-Key`, was sent several times.",
     "Send it once.")

    # Access
    UNAUTHORIZED = ("unauthorized", 401, "Token required",
     "The service requires a token and none was sent.",
     "Send `Authorization: Bearer pliant_…`; the operator creates tokens with `pliant token create`.")
    INVALID_TOKEN = ("invalid_token", 401, "Invalid token",
     "The token is not known; it may have been revoked.",
     "Ask the operator for a new one.")
    EXPIRED_TOKEN = ("expired_token", 401, "Expired token",
     "The token's expiry date has passed.",
     "Ask the operator for a new one.")
    INVALID_SHARE = ("invalid_share", 401, "Invalid share link",
     "The link was revoked, its job was deleted, or the token is not complete.",
     "Ask the sender of the link for a new one.")
    EXPIRED_SHARE = ("expired_share", 401, "Expired share link",
     "The link's expiry date has passed.",
     "Ask the sender of the link for a new one.")
    BEYOND_SHARE = ("beyond_share", 403, "Beyond the share link",
     "A request with the token of a share link named another job, or something other than the job's record, events, files and expiry.",
     "Use a token of the service for anything else.")
    INSUFFICIENT_SCOPE = ("insufficient_scope", 403, "Insufficient scope",
     "The token is valid but lacks the scope that the route needs; `expected` names it.",
     "Use a token with that scope.")
    CROSS_SITE_REQUEST = ("cross_site_request", 403, "Cross site request",
     "A browser sent a write on behalf of a page from another origin.",
     "If that page is yours, have the operator add its origin to `PLIANT_CORS_ORIGINS`.")
    TOO_MANY_REQUESTS = ("too_many_requests", 429, "Rate limit exceeded",
     "The token, or the address where tokens are off, exceeded `requests_per_minute`.",
     "Wait `Retry-After` seconds. The SDK does so by itself.")

    # Jobs
    UNKNOWN_JOB = ("unknown_job", 404, "Unknown job",
     "No job has this id, it has expired, or it belongs to another token.",
     "List your jobs; check `expires_at`.")
    UNKNOWN_ARTIFACT = ("unknown_artifact", 404, "Unknown artifact",
     "The job has no file of this name. Only a succeeded job has files, and `outputs` decides which.",
     "List the job's artifacts.")
    UNKNOWN_EXAMPLE = ("unknown_example", 404, "Unknown example",
     "There is no built-in example, or example file, of this name.",
     "`GET /v1/examples` lists them.")
    NOT_ALLOWED_NOW = ("not_allowed_now", 409, "Not possible in this status",
     "The job's status does not allow the action: for example cancelling a finished job, or deleting a running one.",
     "`detail` states the status and what is possible.")
    NOT_FINISHED = ("not_finished", 409, "Not finished",
     "`result()` was called before the job ended.",
     "Call `wait()`.")
    ID_TAKEN = ("id_taken", 409, "Job id taken",
     "Another request already used this job id with different content, or another token uses it.",
     "Choose another id.")
    IDEMPOTENCY_CONFLICT = ("idempotency_conflict", 409, "Idempotency conflict",
     "The `Idempotency-Key` was used before for a different request.",
     "Use a new key for a new request.")
    INVALID_ID = ("invalid_id", 422, "Invalid id",
     "A job or upload id does not consist of 3 to 64 letters, digits, underscores or dashes.",
     "Choose another id, or omit it.")
    INVALID_IDEMPOTENCY_KEY = ("invalid_idempotency_key", 422, "Invalid idempotency key",
     "The key is empty or longer than 255 characters.",
     "Use a random UUID.")
    TOO_MANY_QUEUED = ("too_many_queued", 429, "Queue limit reached",
     "The token's queue limit (`max_queued`) is reached.",
     "Wait until a job starts, or cancel one.")
    UNKNOWN_OPTION = ("unknown_option", 422, "Unknown option",
     "`options` has a name that does not exist.",
     "`GET /v1/options` lists every option.")
    INVALID_OPTION = ("invalid_option", 422, "Invalid option",
     "An option has a wrong type, is out of range, or contradicts another input; `field` names it.",
     "`GET /v1/options` lists types and bounds.")
    OUTPUT_UNAVAILABLE = ("output_unavailable", 422, "Output unavailable",
     "A requested output cannot be written here: `usd` without `usd-core` installed, or `mat` for shapes of 2 GiB or more.",
     "Remove it from `outputs`, or install `pliant[usd]` beside service and worker.")
    INVALID_WEBHOOK = ("invalid_webhook", 422, "Invalid webhook",
     "`webhook` is not an http(s) URL of at most 2,000 characters without user name, or it came without a secret.",
     "Correct the URL, and send `webhook_secret` with it.")
    INVALID_WEBHOOK_SECRET = ("invalid_webhook_secret", 422, "Invalid webhook secret",
     "`webhook_secret` is not `whsec_` followed by 24 to 64 random bytes in base64.",
     'Create one with `echo "whsec_$(openssl rand -base64 32)"`.')
    WEBHOOK_NOT_PUBLIC = ("webhook_not_public", 422, "Webhook not public",
     "The webhook's address is private, loopback or link-local.",
     "Use a public address, or ask the operator to allow its network in `PLIANT_WEBHOOK_NETWORKS`.")
    ARTIFACT_GONE = ("artifact_gone", 410, "Artifact gone",
     "The job was deleted, or expired, while its file was being read.",
     "List your jobs; submit the inputs again if the result is still needed.")

    # Failed jobs
    TIMED_OUT = ("timed_out", 504, "Time limit exceeded",
     "The job exceeded its `time_limit` option or the service's `PLIANT_TIME_LIMIT`.",
     "Raise the limit, send fewer points or frames, or lower `max_reweightings`.")
    OUT_OF_MEMORY = ("out_of_memory", 507, "Out of memory",
     "The job needed more memory than `PLIANT_MEMORY_LIMIT` or the machine has.",
     "Send fewer points or frames, or use a machine with more memory.")
    WORKER_LOST = ("worker_lost", 503, "Worker lost",
     "The job process ended without recording a result: it crashed, was killed, or its worker vanished `PLIANT_MAX_ATTEMPTS` times.",
     "Read the job's log, then retry the job. If it recurs, memory is the usual cause.")
    STORAGE_FAILED = ("storage_failed", 503, "Storage failed",
     "A file of the job could not be read or written.",
     "Free disk space or repair the volume, then retry the job.")
    INTERRUPTED = ("interrupted", None, "Interrupted",
     "A reconstruction stopped because its job was cancelled or its worker is shutting down.",
     "None needed; the job is recorded as cancelled, or queued again.")
    STALE_ATTEMPT = ("stale_attempt", None, "Stale attempt",
     "An attempt that no longer owns its job tried to write. Nothing was written.",
     "None needed; another attempt owns the job.")

    # Storage
    STORE_UNAVAILABLE = ("store_unavailable", 503, "Store unavailable",
     "Redis or the blob store does not answer, or is full.",
     "Repeat the request after `Retry-After`; accepted jobs are safe.")
    STORAGE_FULL = ("storage_full", 507, "Storage full",
     "The data volume is full. Nothing of the request was kept.",
     "Operators free space or lower `PLIANT_RETENTION`; clients retry later.")
    QUOTA_EXCEEDED = ("quota_exceeded", 507, "Quota exceeded",
     "Jobs and uploads together would exceed `PLIANT_DISK_QUOTA`.",
     "Delete jobs, wait until some expire, or raise the quota.")
    WORKER_ERROR = ("worker_error", 500, "Worker error",
     "The queue or the store failed in a way that has no code of its own.",
     "Report it with the service's log.")

    # Uploads
    UNKNOWN_UPLOAD = ("unknown_upload", 404, "Unknown upload",
     "No upload has this id; it expired, or belongs to another token.",
     "Send it again.")
    UPLOAD_INCOMPLETE = ("upload_incomplete", 409, "Upload incomplete",
     "The upload has not received all of its bytes.",
     "Ask for its offset with `HEAD` and send the rest.")
    UPLOAD_COMPLETE = ("upload_complete", 409, "Upload complete",
     "Bytes were sent to an upload that is already complete.",
     "Use it in a job, or delete it first.")
    UPLOAD_OFFSET_MISMATCH = ("upload_offset_mismatch", 409, "Upload offset mismatch",
     "The body does not start where the upload ends; `expected` is the right offset.",
     "Continue from that offset.")
    UPLOAD_BUSY = ("upload_busy", 409, "Upload busy",
     "Another process writes to this upload.",
     "Ask for its offset and try again.")
    UPLOAD_TAKEN_OVER = ("upload_taken_over", 409, "Upload taken over",
     "A newer request writes to the same upload; this one was stopped.",
     "Use one connection for one upload.")
    UPLOAD_TOO_LARGE = ("upload_too_large", 413, "Upload too large",
     "The upload exceeds `max_upload_bytes` of `GET /v1/limits`.",
     "Send fewer frames or points, or store `float32`.")
    INCONSISTENT_UPLOAD_LENGTH = ("inconsistent_upload_length", 422, "Inconsistent upload length",
     "`Upload-Length` contradicts the bytes that arrived, or an earlier value.",
     "Send what is missing, or start again at offset 0.")
    INVALID_DIGEST = ("invalid_digest", 422, "Invalid digest",
     "`Repr-Digest` is not `sha-256=:…:` with 32 bytes in base64.",
     "Correct the header or omit it.")
    DIGEST_MISMATCH = ("digest_mismatch", 422, "Digest mismatch",
     "The SHA-256 of the received bytes differs from `Repr-Digest`. The upload was removed.",
     "Send it again.")
    UNKNOWN_SHARE = ("unknown_share", 404, "Unknown share link",
     "The job has no share link of that id; it may have expired.",
     "`GET /v1/jobs/{id}/shares` lists the valid ones.")
    TOO_MANY_SHARES = ("too_many_shares", 409, "Too many share links",
     "The job has 20 valid share links.",
     "Revoke one, or wait until one expires.")
    TOO_MANY_UPLOADS = ("too_many_uploads", 429, "Too many uploads",
     "The token has 100 uploads.",
     "Delete some, or wait until they expire.")

    # Input files
    NOT_A_RESULT = ("not_a_result", None, "Not a result",
     "`pliant view` named a folder without `report.json` and `preview.bin`.",
     "Name the folder that `pliant solve -o` or `pliant result -o` wrote.")
    FILM_AS_TRACKS = ("film_as_tracks", 422, "A film sent as tracks",
     "The part `tracks` is a film or a zip of pictures.",
     "Send it as the part `film`; `pliant submit FILM` and the page recognise films by themselves.")
    PICTURE_AS_TRACKS = ("picture_as_tracks", 422, "A picture sent as tracks",
     "The part `tracks` is a single picture, which shows no motion.",
     "Send a film, or a zip of its pictures, as the part `film`.")
    UNREADABLE_TABLE = ("unreadable_table", 422, "Unreadable table",
     "A line of a table of tracks has other columns than expected, or something that is not a number; `got` shows the line.",
     "One observation a line with the columns `frame, point, x, y`, or one row a frame with named columns such as `nose_x, nose_y`. "
     "Decimal commas need semicolons or tabs between the columns.")
    UNKNOWN_FORMAT = ("unknown_format", 422, "Unknown format",
     "The content of the file is of no supported format, or a mesh text is neither a file nor `ROWSxCOLUMNS`.",
     'Convert it, for example `numpy.savez("tracks.npz", tracks=points, visibility=visible)`.')
    EMPTY_FILE = ("empty_file", 422, "Empty file",
     "The file has no bytes.",
     "Send the file again.")
    DAMAGED_FILE = ("damaged_file", 422, "Damaged file",
     "The file is incomplete or inconsistent.",
     "Write the file again; check that the transfer was complete.")
    PICKLE_REFUSED = ("pickle_refused", 422, "Pickle refused",
     "The file is a Python pickle (`.pkl`, `.pt`, `.pth`), which runs code when it is read.",
     'Convert it where it was made: `numpy.savez("tracks.npz", tracks=tracks.cpu().numpy())`.')
    OBJECT_ARRAY = ("object_array", 422, "Object array",
     "The file holds an array of Python objects, which is a pickle inside.",
     "Save a plain array: `numpy.asarray(x, dtype=float)`.")
    UNSUPPORTED_FEATURE = ("unsupported_feature", 422, "Unsupported feature",
     "The format is supported but not this feature of it: encrypted or LZMA members, HDF5 links and external storage, "
     "compressed glTF, 3-D points without intrinsics.",
     "Save the data plainly; `hint` states how.")
    TOO_LARGE = ("too_large", 422, "Input too large",
     "The file declares or contains more than this installation accepts.",
     "Use fewer frames or points, or ask the operator; `GET /v1/limits` has the numbers.")
    NEEDS_MORE_MEMORY = ("needs_more_memory", 422, "Needs more memory than any worker has",
     "The job's estimated memory exceeds that of every running worker.",
     "Use the `max_points` or `frames` that the hint names, or ask the operator for a larger worker.")
    TOO_SLOW = ("too_slow", 422, "Parsing took too long",
     "The file could not be parsed within the time limit.",
     "Convert it to npz.")
    MEMBER_NAME = ("member_name", 422, "Unsafe member name",
     "A member of an npz archive has a path or an unusual name.",
     "Write the file with `numpy.savez` and plain names.")
    DUPLICATE_MEMBER = ("duplicate_member", 422, "Duplicate member",
     "An npz archive has two members of one name.",
     "Write the file again.")
    DUPLICATE_OBSERVATION = ("duplicate_observation", 422, "Duplicate observation",
     "A CSV has two rows for one frame and point.",
     "Keep one.")
    MISSING_ARRAY = ("missing_array", 422, "Missing array",
     "No array or column of a known name was found; `got` lists what is there.",
     "Name the tracks `tracks` or `W`, the truth `shapes` or `S`, the cameras `rotations`, the mesh `faces` or `grid`, "
     "intrinsics `intrinsics`.")

    # Films
    FILM_UNAVAILABLE = ("film_unavailable", 422, "Films not supported here",
     "A film was sent to an installation without OpenCV.",
     "Install `pliant[film]` beside service and worker, or send tracks.")
    UNSUPPORTED_FILM = ("unsupported_film", 422, "Unsupported film",
     "The content of the file is none of mp4, mov, webm, mkv, avi, animated GIF or a zip of pictures.",
     "Convert it: `ffmpeg -i FILM film.mp4`.")
    UNREADABLE_FILM = ("unreadable_film", 422, "Unreadable film",
     "The film's file cannot be opened.",
     "Check the path and its permissions.")
    EMPTY_FILM = ("empty_film", 422, "Empty film",
     "The film's file has no bytes.",
     "Copy the film again.")
    PLAYLIST = ("playlist", 422, "Playlist",
     "The file is a playlist or text that refers to other files or addresses, which are never opened.",
     "Send the film itself.")
    EXTERNAL_REFERENCE = ("external_reference", 422, "External reference",
     "The film's samples lie in another file.",
     "Export the film with its media inside.")
    TRUNCATED_FILM = ("truncated_film", 422, "Truncated film",
     "The film was cut off before the recording ended: its index or header is missing.",
     "Copy it again, or film again.")
    UNDECODABLE_FILM = ("undecodable_film", 422, "Undecodable film",
     "The film holds no picture that can be decoded.",
     "Convert it: `ffmpeg -i FILM film.mp4`.")
    NO_PICTURE = ("no_picture", 422, "No picture",
     "The film holds sound only, or the zip no pictures.",
     "Send a film with a picture track.")
    BROKEN_PICTURE = ("broken_picture", 422, "Broken picture",
     "A picture of a zip or GIF cannot be decoded.",
     "Save it again as PNG or JPEG.")
    CHANGING_SIZE = ("changing_size", 422, "Changing size",
     "The frames of the film differ in size.",
     "Export all frames in one size.")
    TOO_SMALL = ("too_small", 422, "Film too small",
     "The frames are smaller than 16×16 pixels.",
     "Film at 640×480 or more.")
    TOO_MANY_STREAMS = ("too_many_streams", 422, "Too many streams",
     "The film has more than 16 streams.",
     "Keep the picture: `ffmpeg -i FILM -map 0:v:0 film.mp4`.")
    TOO_MANY_PICTURES = ("too_many_pictures", 422, "Too many pictures",
     "A zip lists more pictures than this installation accepts.",
     "Put fewer pictures in the zip.")
    TOO_MANY_BYTES = ("too_many_bytes", 422, "Too many bytes",
     "The film, or the pictures of a zip unpacked, are larger than this installation accepts.",
     "Cut the film, or compress it more.")
    TOO_MANY_PIXELS = ("too_many_pixels", 422, "Too many pixels",
     "The frames are larger than 4096×2304 pixels.",
     "Scale the film down: `ffmpeg -i FILM -vf scale=1280:-2 film.mp4`.")
    TOO_MANY_FRAMES = ("too_many_frames", 422, "Too many frames",
     "More frames are to be tracked than this installation accepts.",
     "Select some with `frames`, for example `0:3000:2`.")
    TOO_LONG = ("too_long", 422, "Film too long",
     "The film plays for longer than ten minutes up to the last frame that is used.",
     "Select a part with `frames`, or cut the film.")
    WRONG_SELECTION = ("wrong_selection", 422, "Wrong selection of frames",
     "The option `frames` selects nothing from a film; negative numbers are not possible there.",
     "Write `start:stop:step`, for example `0:300:2`.")
    NO_SUCH_FRAME = ("no_such_frame", 422, "No such frame",
     "`template_frame` or `region_frame` lies beyond the film's end.",
     "Frames are counted in the whole film from 0.")
    UNREADABLE_REGION = ("unreadable_region", 422, "Unreadable region",
     "The region is no picture that can be read.",
     "Save the mask as PNG: white inside, black outside.")
    WRONG_REGION = ("wrong_region", 422, "Wrong region",
     "A region given as an array is neither a mask `(H, W)` nor a polygon `(N, 2)`.",
     "Convert the array.")
    WRONG_REGION_SIZE = ("wrong_region_size", 422, "Wrong size of the region",
     "The mask picture has another size than the film.",
     "Draw the region on a frame of this film, upright as it is shown.")
    WRONG_POLYGON = ("wrong_polygon", 422, "Wrong polygon",
     "The polygon has fewer than three corners, or coordinates that are not finite.",
     "Draw around the object to track.")
    EMPTY_REGION = ("empty_region", 422, "Empty region",
     "The region holds no pixel of the film.",
     "Draw around the object to track.")
    REGION_LOST = ("region_lost", 422, "Region lost",
     "The region cannot be followed from the frame it was drawn on to the template.",
     "Draw it on the template frame (`region_frame`), or choose a nearer `template_frame`.")
    NO_TEXTURE = ("no_texture", 422, "No texture",
     "The region has too little texture to follow.",
     "Draw a larger region, or film a surface with a pattern, in focus and in good light.")
    TRACKS_LOST = ("tracks_lost", 422, "Tracks lost",
     "Too few points stay visible through the film.",
     "Film more slowly and with more light.")
    OUTSIDE_PICTURE = ("outside_picture", 422, "Outside the picture",
     "Half or more of the visible observations lie outside `image_size`.",
     "Correct `image_size`, or omit it if tracks are not in pixels from the picture's corner.")
    PRINCIPAL_POINT_FAR = ("principal_point_far", 422, "Principal point too far",
     "`principal_point`, or the centre of `image_size`, lies far from all tracks.",
     "Give x and y in the unit and axes of the tracks.")
    UNWRITABLE_FILM = ("unwritable_film", None, "Film cannot be written",
     "`pliant.tracking.rendering` could not write a film to the given path.",
     "Check the folder and its permissions.")
    STOPPED = ("stopped", None, "Tracking stopped",
     "`pliant.tracking.track_film` stopped because its `should_stop` returned True. There is no result.",
     "None needed.")

    # Meaning of the input
    AMBIGUOUS_LAYOUT = ("ambiguous_layout", 422, "Ambiguous layout",
     "Two readings of the array's axes fit equally well.",
     "Set `layout` and `rows` to one of `choices`.")
    AMBIGUOUS_COORDINATES = ("ambiguous_coordinates", 422, "Ambiguous coordinates",
     "The coordinates could be pixels or fractions of the picture.",
     "Set `image_size=WIDTHxHEIGHT` for fractions, else `coordinates=pixels`.")
    MISSING_IMAGE_SIZE = ("missing_image_size", 422, "Missing image size",
     "The option `coordinates` states fractions, but the picture's size is unknown.",
     "Set `image_size`.")
    WRONG_TYPE = ("wrong_type", 422, "Wrong type",
     "An array has the wrong type, such as text or complex numbers.",
     "Convert it as `hint` states.")
    WRONG_SHAPE = ("wrong_shape", 422, "Wrong shape",
     "An array has the wrong shape; `expected` and `got` state both.",
     "Transpose or reshape it.")
    OUT_OF_RANGE = ("out_of_range", 422, "Out of range",
     "Values lie outside what they can mean: visibility outside 0 to 1, coordinates beyond ±10¹², a grid number out of bounds.",
     "Correct the values, or set the option named in `hint`.")
    NOT_FINITE = ("not_finite", 422, "Values are not finite",
     "Ground truth has NaN or infinity; or, in a failed job, the solver's arithmetic overflowed.",
     "Supply finite truth for every point; check the tracks for absurdly large values.")
    TOO_FEW_FRAMES = ("too_few_frames", 422, "Too few frames",
     "Fewer than three frames.",
     "Track a longer clip.")
    TOO_FEW_POINTS = ("too_few_points", 422, "Too few points",
     "Fewer than four points, perhaps after `stride` or `max_points`.",
     "Track more points, or decimate less.")
    NO_FRAMES_LEFT = ("no_frames_left", 422, "No frames left",
     "The option `frames` selects fewer than three frames.",
     "Widen the range.")
    NOTHING_VISIBLE = ("nothing_visible", 422, "Nothing visible",
     "No observation is both finite and visible, or no point is seen in `min_seen` frames.",
     "Check for inverted visibility; lower `min_seen`.")
    TOO_LITTLE_SEEN = ("too_little_seen", 422, "Too few points seen",
     "Fewer than four points are seen in two frames or more.",
     "Check that visibility is not inverted and that point p is the same point in every frame.")
    NO_EXTENT = ("no_extent", 422, "All points coincide",
     "All points coincide, in the tracks or in a frame of the ground truth.",
     "Check the order of the axes.")
    VERTEX_COUNT_MISMATCH = ("vertex_count_mismatch", 422, "Vertex count mismatch",
     "The mesh file has another number of vertices than the tracks have points.",
     "Vertex i must be point i. Omit the mesh to have one generated.")
    MESH_MISMATCH = ("mesh_mismatch", 422, "Mesh mismatch",
     "The mesh given to `pliant.solver.solve` has another number of vertices than the tracks have points.",
     "Vertex i must be point i.")
    INDEX_OUT_OF_RANGE = ("index_out_of_range", 422, "Index out of range",
     "A face or grid names a vertex that does not exist, or a grid repeats or skips one.",
     "Indices start at 0 and end at points − 1.")
    DEGENERATE_FACE = ("degenerate_face", 422, "Degenerate face",
     "A face names a vertex twice.",
     "Remove it.")
    NOT_A_ROTATION = ("not_a_rotation", 422, "Not a rotation",
     "The rows of a given rotation are not orthonormal.",
     "Supply unit rows; give scales separately.")
    CAMERA_MISMATCH = ("camera_mismatch", 422, "Camera mismatch",
     "The number of given rotations differs from the number of frames.",
     "Give one rotation per frame.")

    # Command line and start-up
    INVALID_SETTING = ("invalid_setting", None, "Invalid setting",
     "An environment variable does not parse or is out of range.",
     "Correct the variable, or unset it to use the default.")
    DATA_DIRECTORY_IN_USE = ("data_directory_in_use", None, "Data directory in use",
     "Another Pliant process owns the data directory.",
     "Stop it, or name another directory with `--data`.")
    NEWER_DATA = ("newer_data", None, "Data of a newer version",
     "A newer Pliant wrote the records, and this one could drop what it does not know.",
     "Install that version, or restore a backup from before the upgrade.")
    BAD_BACKUP = ("bad_backup", None, "Bad backup",
     "The directory holds no backup, or a damaged one, or the installation is not empty.",
     "Name another directory; restore into an installation without jobs and tokens.")
    SERVER_FAILED = ("server_failed", None, "Valkey did not start",
     "The embedded Valkey did not start; the message ends with its log.",
     "Run `pliant doctor`.")
    UNKNOWN_TOKEN = ("unknown_token", 404, "Unknown token",
     "`pliant token revoke` or `--sharing` named a token that does not exist.",
     "`pliant token list`.")
    INVALID_TOKEN_NAME = ("invalid_token_name", None, "Invalid token name",
     "A token's name is empty, too long, or has control characters.",
     "Choose a short printable name.")
    INVALID_TOKEN_TEXT = ("invalid_token_text", None, "Invalid token",
     "The file of `pliant token create --from` does not hold a token.",
     "Write a token of the stated form to it, or leave --from out.")
    INVALID_DURATION = ("invalid_duration", None, "Invalid duration",
     "`--expires` is not a duration such as `12h`, `90d` or `52w`.",
     "Correct it, or omit it for a token without expiry.")
    NO_SCOPE = ("no_scope", None, "Token without scope",
     "A token was requested without any scope.",
     "Add `--scope read`.")
    # fmt: on


def type_of(code: str) -> str:
    """Return the relative reference that a problem document has as its `type`."""
    return f"/errors/{code}"


def find_code(code: str) -> ProblemCode | None:
    """Return the table's entry of a code, or None for a code that this version does not know."""
    return ProblemCode.__members__.get(code.upper())
