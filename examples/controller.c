/* One trial from C: fetch the widths for a reference torque, play them, wait for the end, fetch the recording.
 *
 *   gcc -std=c11 -Wall -Wextra -o controller examples/controller.c -lcurl -lcjson -lm
 *   STIMRIG_TOKEN=… ./controller http://127.0.0.1:8000 P017 trial.h5
 *
 * Needs libcurl and cJSON (Debian: libcurl4-openssl-dev, libcjson-dev). Every answer that is not 2xx ends the program
 * with the sentence of the service: it says what is wrong and what to do. If the program ends while its trial plays, by
 * an error or by Ctrl-C, it presses stop first.
 */
#define _POSIX_C_SOURCE 200809L
#include <cjson/cJSON.h>
#include <curl/curl.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <time.h>

struct body {
    char *data;
    size_t size;
};

static size_t keep(char *part, size_t size, size_t count, void *into)
{
    struct body *body = into;
    char *grown = realloc(body->data, body->size + size * count + 1);
    if (grown == NULL)
        return 0; /* curl ends the request then */
    memcpy(grown + body->size, part, size * count);
    body->data = grown;
    body->size += size * count;
    body->data[body->size] = '\0';
    return size * count;
}

static const char *url, *key;
static char planned_with[80]; /* ETag of the model: a trial says with which one it was planned */
static int playing; /* a trial of ours may be playing */
static volatile sig_atomic_t interrupted;

/* The first ETag that comes is the model's. */
static size_t tag(char *line, size_t size, size_t count, void *unused)
{
    (void)unused;
    if (planned_with[0] == '\0' && size * count > 6 && strncasecmp(line, "etag:", 5) == 0)
        sscanf(line + 5, " %79[^\r\n]", planned_with);
    return size * count;
}

static void interrupt(int number)
{
    (void)number;
    interrupted = 1;
}

/* libcurl asks again and again: another value than 0 ends the request. */
static int given_up(void *unused, curl_off_t a, curl_off_t b, curl_off_t c, curl_off_t d)
{
    (void)unused, (void)a, (void)b, (void)c, (void)d;
    return interrupted;
}

/* One request, whatever comes of it; `sent` is JSON, or NULL for GET. What comes is the caller's to free. */
static CURLcode send_to(const char *path, const char *sent, long seconds, struct body *got, long *status)
{
    size_t size = strlen(url) + strlen(path) + strlen(key) + sizeof planned_with + 32;
    char *text = malloc(size);
    CURL *curl = curl_easy_init();
    if (curl == NULL || text == NULL)
        return CURLE_FAILED_INIT;
    snprintf(text, size, "Authorization: Bearer %s", key);
    struct curl_slist *head = curl_slist_append(NULL, text);
    head = curl_slist_append(head, "Content-Type: application/json");
    snprintf(text, size, "If-Match: %s", planned_with);
    if (sent != NULL && planned_with[0] != '\0')
        head = curl_slist_append(head, text);
    snprintf(text, size, "%s%s", url, path);
    curl_easy_setopt(curl, CURLOPT_URL, text);
    curl_easy_setopt(curl, CURLOPT_HTTPHEADER, head);
    curl_easy_setopt(curl, CURLOPT_WRITEFUNCTION, keep);
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, got);
    curl_easy_setopt(curl, CURLOPT_HEADERFUNCTION, tag);
    curl_easy_setopt(curl, CURLOPT_TIMEOUT, seconds);
    curl_easy_setopt(curl, CURLOPT_XFERINFOFUNCTION, given_up);
    curl_easy_setopt(curl, CURLOPT_NOPROGRESS, 0L);
    if (sent != NULL)
        curl_easy_setopt(curl, CURLOPT_POSTFIELDS, sent);
    CURLcode code = curl_easy_perform(curl);
    curl_easy_getinfo(curl, CURLINFO_RESPONSE_CODE, status);
    curl_slist_free_all(head);
    curl_easy_cleanup(curl);
    free(text);
    return code;
}

static void press_stop(void)
{
    struct body got = {NULL, 0};
    long status = 0;
    interrupted = 0; /* a stop is not given up */
    playing = 0;
    if (send_to("/v1/stop", "{\"reason\": \"the controller ended\"}", 10L, &got, &status) == CURLE_OK && status == 200)
        fprintf(stderr, "stop was pressed; a person re-arms the rig\n");
    else
        fprintf(stderr, "STOP WAS NOT CONFIRMED: use the emergency switch on the stimulator now\n");
    free(got.data);
}

static void fail(const char *what, const char *why)
{
    fprintf(stderr, "%s: %s\n", what, why);
    if (playing)
        press_stop();
    exit(1);
}

static const char *text_of(const cJSON *object, const char *name)
{
    const cJSON *found = cJSON_GetObjectItemCaseSensitive(object, name);
    return cJSON_IsString(found) ? found->valuestring : NULL;
}

/* A text that an answer must hold. */
static const char *needed(const cJSON *object, const char *name)
{
    const char *text = text_of(object, name);
    if (text == NULL)
        fail(name, "is missing in the answer of the service");
    return text;
}

/* A path with a part that may hold any sign. The caller frees it. */
static char *path_of(const char *before, const char *part, const char *after)
{
    char *escaped = curl_easy_escape(NULL, part, 0);
    size_t size = strlen(before) + strlen(after) + (escaped ? strlen(escaped) : 0) + 1;
    char *path = malloc(size);
    if (escaped == NULL || path == NULL)
        fail(before, "no memory");
    snprintf(path, size, "%s%s%s", before, escaped, after);
    curl_free(escaped);
    return path;
}

/* One request that must succeed. `begins`: it starts a trial, which may play even if no answer comes. */
static struct body ask(const char *path, const char *sent, int begins)
{
    struct body got = {NULL, 0};
    long status = 0;
    if (begins)
        playing = 1;
    CURLcode code = send_to(path, sent, 60L, &got, &status);
    if (code != CURLE_OK)
        fail(path, curl_easy_strerror(code));
    if (status < 200 || status > 299) {
        if (begins)
            playing = 0; /* it was refused: whatever plays is not ours */
        cJSON *problem = cJSON_Parse(got.data ? got.data : "");
        const char *detail = text_of(problem, "detail");
        fail(path, detail ? detail : "refused without a reason");
    }
    return got;
}

static cJSON *ask_json(const char *path, const char *sent, int begins)
{
    struct body got = ask(path, sent, begins);
    cJSON *found = cJSON_Parse(got.data ? got.data : "");
    free(got.data);
    if (found == NULL)
        fail(path, "the answer is no JSON");
    return found;
}

/* The widths for a bell of torque: `segments` of a trial, and the `pulse_rate_hz` they hold for. The caller frees it. */
static cJSON *plan(const char *model)
{
    enum { PULSES = 240 }; /* six seconds at 40 pulses a second */
    cJSON *wanted = cJSON_CreateObject();
    cJSON *torque = cJSON_AddArrayToObject(wanted, "reference_torque_nm");
    for (int k = 0; k < PULSES; k++)
        cJSON_AddItemToArray(torque, cJSON_CreateNumber(0.5 * pow(sin(2 * 3.14159265358979 * k / PULSES), 2)));
    char *sent = cJSON_PrintUnformatted(wanted);
    char *path = path_of("/v1/models/", model, "/widths");
    cJSON *found = ask_json(path, sent, 0);
    free(path);
    free(sent);
    cJSON_Delete(wanted);
    const cJSON *lacks = NULL;
    cJSON_ArrayForEach(lacks, cJSON_GetObjectItemCaseSensitive(found, "unreachable"))
        fprintf(stderr, "out of reach: %s\n", needed(lacks, "reason"));
    return found;
}

/* Play the trial; the id of its recording, which the caller frees. */
static char *play(const char *participant, cJSON *planned)
{
    cJSON *body = cJSON_CreateObject();
    cJSON_AddStringToObject(body, "participant", participant);
    cJSON_AddStringToObject(body, "kind", "sequence");
    const char *taken[] = {"segments", "pulse_rate_hz"};
    for (int i = 0; i < 2; i++) {
        cJSON *item = cJSON_DetachItemFromObjectCaseSensitive(planned, taken[i]);
        if (item == NULL)
            fail(taken[i], "is missing in the answer of the service");
        cJSON_AddItemToObject(body, taken[i], item);
    }
    cJSON_Delete(planned);
    char *sent = cJSON_PrintUnformatted(body);
    cJSON *test = ask_json("/v1/tests", sent, 1);
    free(sent);
    cJSON_Delete(body);
    char *path = path_of("/v1/tests/", needed(test, "id"), "");
    while (!cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(test, "done"))) {
        nanosleep(&(struct timespec){0, 200 * 1000 * 1000}, NULL);
        if (interrupted)
            fail(path, "interrupted");
        cJSON_Delete(test);
        test = ask_json(path, NULL, 0);
    }
    playing = 0;
    free(path);
    if (strcmp(needed(test, "state"), "completed") != 0)
        fail(needed(test, "state"), needed(test, "reason"));
    char *recording = strdup(needed(test, "recording_id"));
    cJSON_Delete(test);
    return recording;
}

int main(int count, char **words)
{
    key = getenv("STIMRIG_TOKEN");
    if (count != 4 || key == NULL)
        fail("usage", "STIMRIG_TOKEN=… controller URL PARTICIPANT FILE.h5");
    url = words[1];
    curl_global_init(CURL_GLOBAL_DEFAULT);
    sigaction(SIGINT, &(struct sigaction){.sa_handler = interrupt}, NULL);
    sigaction(SIGTERM, &(struct sigaction){.sa_handler = interrupt}, NULL);
    char *path = path_of("/v1/participants/", words[2], "/model");
    cJSON *model = ask_json(path, NULL, 0);
    free(path);
    char *recording = play(words[2], plan(needed(model, "model_id")));
    path = path_of("/v1/recordings/", recording, "");
    struct body file = ask(path, NULL, 0);
    free(path);
    FILE *out = fopen(words[3], "wb");
    if (out == NULL || fwrite(file.data, 1, file.size, out) != file.size || fclose(out) != 0)
        fail(words[3], "cannot be written");
    printf("%s: %zu bytes\n", words[3], file.size);
    free(file.data);
    free(recording);
    cJSON_Delete(model);
    curl_global_cleanup();
    return 0;
}
